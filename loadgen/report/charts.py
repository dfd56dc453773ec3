"""The charts of a report, drawn with matplotlib; what they show comes from `findings`.

Each series is named in the SVG (`points-onboard`, `line-cloud`, ..), so that it can be found there.
"""

import io
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import ceil
from typing import Any

import numpy as np

from offboard.common.errors import MissingExtra
from offboard.loadgen.report.chart_data import Accuracies, Decisions, Interval, Times, ecdf
from offboard.loadgen.report.chart_styles import (
    LOOKS,
    NEUTRAL,
    PAPER,
    PRINTED,
    STYLE,
    Look,
    policy_look,
    predictor_look,
)
from offboard.loadgen.table import published_table_two as paper
from offboard.loadgen.table.measured_rows import Column
from offboard.loadgen.table.replay import ORACLE, RECORDED
from offboard.loadgen.table.table_settings import FULL_WINDOW, PAPER_WINDOWS
from offboard.loadgen.table.table_two_figures import Score
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

try:
    import matplotlib.style
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.colors import to_rgba
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.ticker import LogLocator, NullFormatter, PercentFormatter, StrMethodFormatter
except ImportError as error:
    raise MissingExtra("loadgen report", "report") from error

WIDTH_IN, HEIGHT_IN = 4.8, 3.5  # so narrow that letters stay legible where a phone shrinks the chart
PNG_DPI = 300
FAR = 10  # times the median: a greatest time beyond makes the scale logarithmic
WIDE = 30  # greatest error by least error, from which their scale is logarithmic
LEGEND_LINE_IN = 0.2
LABELS_TO = 100  # greatest by least up to which 2 and 5 are labelled beside 1


@dataclass(frozen=True, slots=True)
class Drawing:
    """One chart as two files."""

    svg: bytes
    png: bytes


def draw(name: str, shown: Any) -> Drawing:
    """One of `PAINTERS`; the same for the same `shown`, whatever the user's settings of matplotlib."""
    with matplotlib.style.context(["default", STYLE]):
        figure = Figure(figsize=(WIDTH_IN, HEIGHT_IN), layout="constrained")
        PAINTERS[name](figure, shown)
        svg, png = io.BytesIO(), io.BytesIO()
        figure.savefig(svg, format="svg")
        figure.savefig(png, format="png", dpi=PNG_DPI)
        return Drawing(svg.getvalue(), png.getvalue())


def times(figure: Figure, shown: Times) -> None:
    """Seconds against size: both sites' points and lines, and where the lines cross."""
    axes = figure.add_subplot(xlabel="input size d", ylabel="execution time (s)")
    rows = shown.rows
    _points(axes, rows.size, rows.onboard_s, ONBOARD, gid="points-onboard", opacity=0.35)
    _points(axes, rows.size, rows.cloud_s, CLOUD, gid="points-cloud", opacity=0.35)
    # Where all sizes are equal the lines are level, and as wide as the chart.
    ends = np.array([shown.low, shown.high] if shown.low < shown.high else axes.get_xlim())
    for site, line in ((ONBOARD, shown.onboard), (CLOUD, shown.cloud)):
        axes.plot(ends, line.at(ends), color=(1, 1, 1, 0.7), linewidth=3.6)  # lifts it off the points
        axes.plot(
            ends, line.at(ends), color=LOOKS[site].colour, linestyle=LOOKS[site].line, gid=f"line-{site}"
        )
    keys = [_key(LOOKS[site], site) for site in (ONBOARD, CLOUD)]
    if shown.crossing is not None and shown.crossing_inside:
        keys.append(_mark_crossing(axes, shown.crossing, shown.onboard.at(shown.crossing)))
    _legend(figure, keys, columns=3)


def decisions(figure: Figure, shown: Decisions) -> None:
    """Time and site of each task in order, above the share of the cloud among the latest tasks."""
    above, below = figure.subplots(2, sharex=True, height_ratios=(2, 1))
    above.set_ylabel("time waited (s)" if shown.policy == RECORDED else "execution time (s)")
    for site, chosen in ((ONBOARD, ~shown.to_cloud), (CLOUD, shown.to_cloud)):
        _points(above, shown.number[chosen], shown.seconds[chosen], site, gid=f"chosen-{site}", opacity=0.65)
    _scale_times(above.set_yscale, above.yaxis, shown.seconds)
    below.set(xlabel="task", ylabel="to cloud", ylim=(-4, 104), yticks=(0, 50, 100))
    below.yaxis.set_major_formatter(PercentFormatter(decimals=0))
    look, best = policy_look(shown.policy), LOOKS[ORACLE]
    below.plot(shown.number, shown.share_percent, color=look.colour, gid="share")
    keys = [_key(replace(LOOKS[site], line=""), site) for site in (ONBOARD, CLOUD)]
    keys.append(_key(Look(look.colour), f"share to cloud, {shown.policy}"))
    if shown.best_percent is not None:
        below.plot(
            shown.number,
            shown.best_percent,
            color=best.colour,
            linestyle=best.line,
            linewidth=1.2,
            gid="share-oracle",
        )
        keys.append(_key(best, f"share to cloud, {ORACLE}"))
    figure.align_ylabels()
    _legend(figure, keys, columns=2)


def errors(figure: Figure, scores: Sequence[Score]) -> None:
    """Mean absolute error and absolute residual of each predictor against N, one panel a site."""
    names = list(dict.fromkeys(score.predictor for score in scores))
    windows = [name for name in PAPER_WINDOWS if any(score.window == name for score in scores)]
    panels = figure.subplots(2, sharex=True, sharey=True)
    for panel, site in zip(panels, (ONBOARD, CLOUD), strict=True):
        panel.set_ylabel(f"{site} error (s)")
        for at, name in enumerate(names):
            own = [score for score in scores if score.predictor == name]
            look = predictor_look(LOOKS[site], at, len(names))
            for measure, field, line in (("mae", "mae_s", "-"), ("residual", "residual_s", ":")):
                values = {score.window: abs(getattr(score, f"{site}_{field}")) for score in own}
                _against_n(panel, windows, values, replace(look, line=line), gid=f"{measure}-{site}-{at}")
    drawn = [
        abs(getattr(score, f"{site}_{field}"))
        for score in scores
        for site in (ONBOARD, CLOUD)
        for field in ("mae_s", "residual_s")
    ]
    low, high = min(drawn), max(drawn)
    if 0 < WIDE * low <= high:
        _logarithmic(panels[0].set_yscale, panels[0].yaxis, low, high)
    _windows_axis(panels[-1], windows)
    keys = [_key(NEUTRAL, "MAE"), _key(replace(NEUTRAL, line=":"), "|residual|", hollow=True)]
    if len(names) > 1:
        looks = [predictor_look(NEUTRAL, at, len(names)) for at in range(len(names))]
        keys += [_key(replace(look, line=""), name) for look, name in zip(looks, names, strict=True)]
    _legend(figure, keys, columns=2)


def accuracy(figure: Figure, shown: Accuracies) -> None:
    """Accuracy against N, the paper's beside it, and what rules without a prediction reach."""
    axes = figure.add_subplot(ylabel="accuracy")
    axes.yaxis.set_major_formatter(PercentFormatter(decimals=0))
    names = list(dict.fromkeys(score.predictor for score in shown.scores))
    keys = []
    _band(axes, shown.intervals)
    for at, name in enumerate(names):
        own = {score.window: score.accuracy_percent for score in shown.scores if score.predictor == name}
        look = predictor_look(LOOKS[PAPER], at, len(names))
        _against_n(axes, PAPER_WINDOWS, own, look, gid=f"accuracy-{at}")
        keys.append(_key(look, name))
    printed = {score.window: score.accuracy_percent for score in paper.SCORES}
    _against_n(axes, PAPER_WINDOWS, printed, PRINTED, gid="accuracy-printed")
    lstm = replace(PRINTED, line="", marker="x")
    _against_n(axes, PAPER_WINDOWS, {FULL_WINDOW: paper.LSTM_PERCENT}, lstm, gid="accuracy-printed-lstm")
    keys += [_key(PRINTED, "the paper's", hollow=True), _key(lstm, "the paper's LSTM")]
    for score in shown.rules:
        look = LOOKS[score.window.removeprefix("always-")]
        assert score.accuracy_percent is not None, "a rule is scored on every row"
        axes.axhline(
            score.accuracy_percent,
            color=look.colour,
            linestyle=look.line,
            linewidth=1.2,
            gid=f"accuracy-{score.window}",
        )
        keys.append(_key(replace(look, marker=""), score.window.replace("-", " ")))
    axes.set_ylim(top=102)
    _windows_axis(axes, PAPER_WINDOWS)
    _legend(figure, keys, columns=3 if len(names) == 1 else 2)


def distributions(figure: Figure, shown: Mapping[str, Column]) -> None:
    """The empirical distribution of the time of a task, one line a policy."""
    axes = figure.add_subplot(xlabel="execution time (s)", ylabel="tasks that took no longer", ylim=(-2, 102))
    axes.yaxis.set_major_formatter(PercentFormatter(decimals=0))
    for name, seconds in shown.items():
        look, gid = policy_look(name), f"ecdf-{re.sub(r'[^a-z0-9]+', '-', name)}"
        axes.step(*ecdf(seconds), where="post", color=look.colour, linestyle=look.line, gid=gid)
    _scale_times(axes.set_xscale, axes.xaxis, np.concatenate(list(shown.values())))
    _legend(
        figure,
        [_key(replace(policy_look(name), marker=""), name) for name in shown],
        columns=4 if len(shown) <= 4 else 3,
    )


def _points(axes: Axes, x: Any, seconds: Column, site: str, *, gid: str, opacity: float) -> None:
    axes.plot(
        x,
        seconds,
        linestyle="",
        marker=LOOKS[site].marker,
        markersize=3.6,
        markerfacecolor=to_rgba(LOOKS[site].colour, opacity),
        markeredgecolor="none",
        gid=gid,
    )


def _mark_crossing(axes: Axes, size: float, seconds: float) -> Line2D:
    axes.axvline(size, color="#222222", linewidth=0.9, linestyle=(0, (2, 2)), gid="crossing-size")
    ring: dict[str, Any] = {"color": "#222222", "marker": "o", "markersize": 7, "markerfacecolor": "white"}
    axes.plot([size], [seconds], **ring, linestyle="", gid="crossing")
    return Line2D([], [], **ring, linestyle="", label=f"lines cross at d = {size:.4g}")


def _against_n(
    axes: Axes, windows: Sequence[str], values: Mapping[str, float | None], look: Look, *, gid: str
) -> None:
    """Values over windows in equal steps; that of the 80:20 split, which has no N, stands alone."""
    found = [values.get(name) for name in windows]
    y = np.array([np.nan if value is None else value for value in found])
    x = np.arange(len(windows), dtype=np.float64)
    if FULL_WINDOW in windows:
        at = windows.index(FULL_WINDOW)
        x, y = np.insert(x, at, at), np.insert(y, at, np.nan)
    hollow = "white" if look.line != "-" else None
    axes.plot(
        x, y, color=look.colour, linestyle=look.line, marker=look.marker, markerfacecolor=hollow, gid=gid
    )


def _band(axes: Axes, intervals: Mapping[str, Interval]) -> None:
    """The interval around a line over windows, and a bar at the 80:20 split."""
    colour = to_rgba(LOOKS[PAPER].colour, 0.2)
    x = [at for at, name in enumerate(PAPER_WINDOWS) if name in intervals and name != FULL_WINDOW]
    if x:
        ends = [intervals[PAPER_WINDOWS[at]] for at in x]
        low, high = [one.low for one in ends], [one.high for one in ends]
        axes.fill_between(x, low, high, facecolor=colour, edgecolor=colour, gid="interval")
    if FULL_WINDOW in intervals:
        full, at = intervals[FULL_WINDOW], PAPER_WINDOWS.index(FULL_WINDOW)
        axes.plot([at, at], [full.low, full.high], color=colour, linewidth=7, gid="interval-full")


def _windows_axis(axes: Axes, windows: Sequence[str]) -> None:
    axes.set_xlabel("N, rows in each window (full: 80:20 split)")
    axes.set_xticks(range(len(windows)), windows)
    axes.set_xlim(-0.5, len(windows) - 0.5)


def _scale_times(set_scale: Callable[[str], None], axis: Axis, seconds: Column) -> None:
    """Logarithmic where a few times are so long that the others would lie on the axis."""
    low, high = float(seconds.min()), float(seconds.max())
    if low > 0 and high > FAR * float(np.median(seconds)):
        _logarithmic(set_scale, axis, low, high)


def _logarithmic(set_scale: Callable[[str], None], axis: Axis, low: float, high: float) -> None:
    set_scale("log")
    axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high <= LABELS_TO * low else (1,)))
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_formatter(NullFormatter())


def _key(look: Look, label: str, *, hollow: bool = False) -> Line2D:
    """A line of the legend."""
    face = "white" if hollow else look.colour
    return Line2D(
        [], [], color=look.colour, linestyle=look.line, marker=look.marker, markerfacecolor=face, label=label
    )


def _legend(figure: Figure, keys: Sequence[Line2D], columns: int) -> None:
    """Above the chart, which grows with it."""
    figure.legend(handles=keys, loc="outside upper left", ncols=columns)
    figure.set_figheight(HEIGHT_IN + LEGEND_LINE_IN * max(0, ceil(len(keys) / columns) - 2))


PAINTERS: dict[str, Callable[[Figure, Any], None]] = {
    "times": times,
    "decisions": decisions,
    "errors": errors,
    "accuracy": accuracy,
    "ecdf": distributions,
}
