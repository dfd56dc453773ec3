"""The charts of a report: which ones there are, and how those of times and decisions are drawn.

The charts over the window size are in `window_charts.py`; what a chart shows comes from `findings.py`. Each
series has a name in the SVG (`points-onboard`, `line-cloud`, ..), by which tests find it.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from offboard.loadgen.replay.replay import ORACLE, RECORDED
from offboard.loadgen.report.chart_data import Decisions, Times, ecdf
from offboard.loadgen.report.chart_parts import (
    Axes,
    Drawing,
    Figure,
    Line2D,
    PercentFormatter,
    key,
    legend,
    points,
    render,
    scale_times,
)
from offboard.loadgen.report.chart_styles import FURTHER_LOOKS, LOOKS, Look, policy_look
from offboard.loadgen.report.window_charts import accuracy, errors
from offboard.loadgen.table.measured_rows import Column
from offboard.robot_client.sites.runner import CLOUD, ONBOARD


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


def decisions(figure: Figure, shown: Decisions) -> None:
    """Time and site of each task in order, and below it the share of the cloud among the latest tasks."""
    above, below = figure.subplots(2, sharex=True, height_ratios=(2, 1))
    above.set_ylabel("waiting time (s)" if shown.policy == RECORDED else "execution time (s)")
    for site, chosen in ((ONBOARD, ~shown.to_cloud), (CLOUD, shown.to_cloud)):
        points(above, shown.number[chosen], shown.seconds[chosen], site, gid=f"chosen-{site}", opacity=0.65)
    scale_times(above.set_yscale, above.yaxis, shown.seconds)
    below.set(xlabel="task number", ylabel="cloud share", ylim=(-4, 104), yticks=(0, 50, 100))
    below.yaxis.set_major_formatter(PercentFormatter(decimals=0))
    look, best = policy_look(shown.policy), LOOKS[ORACLE]
    below.plot(shown.number, shown.share_percent, color=look.colour, gid="share")
    keys = [key(replace(LOOKS[site], line=""), site) for site in (ONBOARD, CLOUD)]
    keys.append(key(Look(look.colour), f"cloud share, {shown.policy}"))
    if shown.best_percent is not None:
        below.plot(
            shown.number,
            shown.best_percent,
            color=best.colour,
            linestyle=best.line,
            linewidth=1.2,
            gid="share-oracle",
        )
        keys.append(key(best, f"cloud share, {ORACLE}"))
    figure.align_ylabels()
    legend(figure, keys, columns=2)


def distributions(figure: Figure, shown: Mapping[str, Column]) -> None:
    """The empirical distribution of the execution time, with a line for each policy."""
    axes = figure.add_subplot(xlabel="execution time (s)", ylabel="tasks done within", ylim=(-2, 102))
    axes.yaxis.set_major_formatter(PercentFormatter(decimals=0))
    for name, seconds in shown.items():
        look, gid = policy_look(name), f"ecdf-{re.sub(r'[^a-z0-9]+', '-', name)}"
        axes.step(*ecdf(seconds), where="post", color=look.colour, linestyle=look.line, gid=gid)
    scale_times(axes.set_xscale, axes.xaxis, np.concatenate(list(shown.values())))
    legend(
        figure,
        [key(replace(policy_look(name), marker=""), name) for name in shown],
        columns=4 if len(shown) <= 4 else 3,
    )


def runs(figure: Figure, shown: Mapping[str, Column]) -> None:
    """The empirical distribution of the waiting time, with a line for each run."""
    axes = figure.add_subplot(xlabel="waiting time (s)", ylabel="tasks answered within", ylim=(-2, 102))
    axes.yaxis.set_major_formatter(PercentFormatter(decimals=0))
    looks = dict(zip(shown, FURTHER_LOOKS, strict=False))
    for number, (name, seconds) in enumerate(shown.items(), 1):
        look = looks[name]
        axes.step(*ecdf(seconds), where="post", color=look.colour, linestyle=look.line, gid=f"run-{number}")
    scale_times(axes.set_xscale, axes.xaxis, np.concatenate(list(shown.values())))
    legend(figure, [key(look, name) for name, look in looks.items()], columns=2)


def _mark_crossing(axes: Axes, size: float, seconds: float) -> Line2D:
    axes.axvline(size, color="#222222", linewidth=0.9, linestyle=(0, (2, 2)), gid="crossing-size")
    ring: dict[str, Any] = {"color": "#222222", "marker": "o", "markersize": 7, "markerfacecolor": "white"}
    axes.plot([size], [seconds], **ring, linestyle="", gid="crossing")
    return Line2D([], [], **ring, linestyle="", label=f"lines cross at d = {size:.4g}")


PAINTERS: dict[str, Callable[[Figure, Any], None]] = {
    "times": times,
    "decisions": decisions,
    "errors": errors,
    "accuracy": accuracy,
    "ecdf": distributions,
    "runs": runs,
}
