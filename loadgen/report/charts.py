"""The charts that matplotlib draws: execution times, error and accuracy by window size, and several runs.

What a chart shows comes from `findings.py`. Each series has a name in the SVG (`points-onboard`, ..), by
which tests find it. The charts of a trace are those of the live page.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from offboard.loadgen.report.chart_data import Accuracies, Interval, Times, ecdf
from offboard.loadgen.report.chart_parts import (
    Axes,
    Drawing,
    Figure,
    Line2D,
    PercentFormatter,
    key,
    legend,
    logarithmic,
    points,
    render,
    scale_times,
    to_rgba,
)
from offboard.loadgen.report.chart_styles import (
    COLOURS,
    LOOKS,
    NEUTRAL,
    PAPER,
    PRINTED,
    RUN_LOOKS,
    Look,
    predictor_look,
)
from offboard.loadgen.table.measured_rows import Column
from offboard.loadgen.table.table_settings import FULL_WINDOW, PAPER_WINDOWS
from offboard.loadgen.table.table_two_figures import LSTM_PERCENT, PUBLISHED, Score
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

WIDE = 30  # the scale of errors is logarithmic if the greatest is at least 30 times the least


def draw(name: str, shown: Any) -> Drawing:
    """Draw one of `PAINTERS`; the same data gives the same files."""
    return render(lambda figure: PAINTERS[name](figure, shown))


def times(figure: Figure, shown: Times) -> None:
    """Seconds against size: points and a line for each site, and where the lines cross."""
    axes = figure.add_subplot(xlabel="input size d", ylabel="execution time (s)")
    rows = shown.rows
    points(axes, rows.size, rows.onboard_s, ONBOARD, gid="points-onboard", opacity=0.35)
    points(axes, rows.size, rows.cloud_s, CLOUD, gid="points-cloud", opacity=0.35)
    # If all sizes are equal, the lines are level and as wide as the chart.
    ends = np.array([shown.low, shown.high] if shown.low < shown.high else axes.get_xlim())
    for site, line in ((ONBOARD, shown.onboard), (CLOUD, shown.cloud)):
        axes.plot(ends, line.at(ends), color=(1, 1, 1, 0.7), linewidth=3.6)  # a light edge over the points
        axes.plot(
            ends, line.at(ends), color=LOOKS[site].colour, linestyle=LOOKS[site].line, gid=f"line-{site}"
        )
    keys = [key(LOOKS[site], site) for site in (ONBOARD, CLOUD)]
    if shown.crossing is not None and shown.crossing_inside:
        keys.append(_mark_crossing(axes, shown.crossing, shown.onboard.at(shown.crossing)))
    legend(figure, keys, columns=3)


def errors(figure: Figure, scores: Sequence[Score]) -> None:
    """Mean absolute error and absolute residual of each predictor against N, with a panel for each site."""
    names = list(dict.fromkeys(score.predictor for score in scores))
    windows = [name for name in PAPER_WINDOWS if any(score.window == name for score in scores)]
    panels = figure.subplots(2, sharex=True, sharey=True)
    for panel, site in zip(panels, (ONBOARD, CLOUD), strict=True):
        panel.set_ylabel(f"{site} error (s)")
        for at, name in enumerate(names):
            own = [score for score in scores if score.predictor == name]
            look = predictor_look(LOOKS[site], at, len(names))
            for measure, line in (("mae", "-"), ("residual", ":")):
                values = {score.window: _error(score, site, measure) for score in own}
                _against_n(panel, windows, values, replace(look, line=line), gid=f"{measure}-{site}-{at}")
    _scale_errors(panels[0], scores)
    _windows_axis(panels[-1], windows)
    keys = [
        key(NEUTRAL, "mean absolute error"),
        key(replace(NEUTRAL, line=":"), "residual, without sign", hollow=True),
    ]
    if len(names) > 1:
        looks = [predictor_look(NEUTRAL, at, len(names)) for at in range(len(names))]
        keys += [key(replace(look, line=""), name) for look, name in zip(looks, names, strict=True)]
    legend(figure, keys, columns=2)


def accuracy(figure: Figure, shown: Accuracies) -> None:
    """Accuracy against N, with the published figures, and the accuracy of policies that predict nothing."""
    axes = figure.add_subplot(ylabel="accuracy")
    axes.yaxis.set_major_formatter(PercentFormatter(decimals=0))
    names = list(dict.fromkeys(score.predictor for score in shown.scores))
    keys = []
    _band(axes, shown.intervals)
    for at, name in enumerate(names):
        own = {score.window: score.accuracy_percent for score in shown.scores if score.predictor == name}
        look = predictor_look(LOOKS[PAPER], at, len(names))
        _against_n(axes, PAPER_WINDOWS, own, look, gid=f"accuracy-{at}")
        keys.append(key(look, name))
    printed = {window: score.accuracy_percent for window, score in PUBLISHED.items()}
    _against_n(axes, PAPER_WINDOWS, printed, PRINTED, gid="accuracy-printed")
    lstm = replace(PRINTED, line="", marker="x")
    _against_n(axes, PAPER_WINDOWS, {FULL_WINDOW: LSTM_PERCENT}, lstm, gid="accuracy-printed-lstm")
    keys += [key(PRINTED, "in the paper", hollow=True), key(lstm, "LSTM in the paper")]
    for score in shown.rules:
        look = LOOKS[score.window.removeprefix("always-")]
        assert score.accuracy_percent is not None, "a constant policy is scored on every row"
        axes.axhline(
            score.accuracy_percent,
            color=look.colour,
            linestyle=look.line,
            linewidth=1.2,
            gid=f"accuracy-{score.window}",
        )
        keys.append(key(replace(look, marker=""), score.window.replace("-", " ")))
    axes.set_ylim(top=102)
    _windows_axis(axes, PAPER_WINDOWS)
    legend(figure, keys, columns=3 if len(names) == 1 else 2)


def runs(figure: Figure, shown: Mapping[str, Column]) -> None:
    """The empirical distribution of the waiting time, with a line for each run."""
    axes = figure.add_subplot(xlabel="waiting time (s)", ylabel="tasks answered within", ylim=(-2, 102))
    axes.yaxis.set_major_formatter(PercentFormatter(decimals=0))
    looks = dict(zip(shown, RUN_LOOKS, strict=False))
    for number, (name, seconds) in enumerate(shown.items(), 1):
        look = looks[name]
        axes.step(*ecdf(seconds), where="post", color=look.colour, linestyle=look.line, gid=f"run-{number}")
    scale_times(axes.set_xscale, axes.xaxis, np.concatenate(list(shown.values())))
    legend(figure, [key(look, name) for name, look in looks.items()], columns=2)


def _mark_crossing(axes: Axes, size: float, seconds: float) -> Line2D:
    axes.axvline(size, color=COLOURS["text"], linewidth=0.9, linestyle=(0, (2, 2)), gid="crossing-size")
    ring: dict[str, Any] = {
        "color": COLOURS["text"],
        "marker": "o",
        "markersize": 7,
        "markerfacecolor": "white",
    }
    axes.plot([size], [seconds], **ring, linestyle="", gid="crossing")
    return Line2D([], [], **ring, linestyle="", label=f"lines cross at d = {size:.4g}")


def _error(score: Score, site: str, measure: str) -> float:
    """The mean absolute error ("mae") or the absolute residual ("residual") of a site, in seconds."""
    seconds: float = getattr(score, f"{site}_{measure}_s")
    return abs(seconds)


def _scale_errors(axes: Axes, scores: Sequence[Score]) -> None:
    drawn = [
        _error(score, site, measure)
        for score in scores
        for site in (ONBOARD, CLOUD)
        for measure in ("mae", "residual")
    ]
    low, high = min(drawn), max(drawn)
    if 0 < WIDE * low <= high:
        logarithmic(axes.set_yscale, axes.yaxis, low, high)


def _against_n(
    axes: Axes, windows: Sequence[str], values: Mapping[str, float | None], look: Look, *, gid: str
) -> None:
    """Draw values over equally spaced windows; the value of the 80:20 split is not joined to the line."""
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
    """Draw the interval as a band around the line, and as a bar at the 80:20 split."""
    colour = to_rgba(LOOKS[PAPER].colour, 0.2)
    x = [at for at, name in enumerate(PAPER_WINDOWS) if name in intervals and name != FULL_WINDOW]
    if x:
        ends = [intervals[PAPER_WINDOWS[at]] for at in x]
        low, high = [interval.low for interval in ends], [interval.high for interval in ends]
        axes.fill_between(x, low, high, facecolor=colour, edgecolor=colour, gid="interval")
    if FULL_WINDOW in intervals:
        full, at = intervals[FULL_WINDOW], PAPER_WINDOWS.index(FULL_WINDOW)
        axes.plot([at, at], [full.low, full.high], color=colour, linewidth=7, gid="interval-full")


def _windows_axis(axes: Axes, windows: Sequence[str]) -> None:
    axes.set_xlabel("window size N, in tasks (full: 80:20 split)")
    axes.set_xticks(range(len(windows)), windows)
    axes.set_xlim(-0.5, len(windows) - 0.5)


PAINTERS: dict[str, Callable[[Figure, Any], None]] = {
    "times": times,
    "errors": errors,
    "accuracy": accuracy,
    "runs": runs,
}
