"""The picture of an application: the time of each task on both sites, and the site that `default` chose.

The figures come from `application_tables`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.application_tables import CONSTANTS, DEFAULT, Known, Run
from offboard.loadgen.report.chart_parts import Figure, Line2D, key, legend, points, render, scale_times
from offboard.loadgen.report.chart_styles import LOOKS
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

RING: dict[str, Any] = {
    "color": "#222222",
    "marker": "o",
    "markersize": 7,
    "markerfacecolor": "none",
    "markeredgewidth": 0.6,
    "linestyle": "",
}


@dataclass(frozen=True, slots=True)
class Across:
    """What the horizontal axis shows: the size or the work of a task, whichever explains its time better.

    One unit of the axis is `unit` units of size or work.
    """

    label: str
    of: str = "size"
    unit: float = 1.0

    def value(self, known: Known) -> float | None:
        amount: float | None = getattr(known, self.of)
        return None if amount is None else amount / self.unit


ACROSS = {
    "apriltags": Across("size of the frame (million pixels)", unit=1e6),
    "registration": Across("work (thousand points x iterations)", of="work", unit=1e3),
    "signs": Across("work (20 for the frame, 1 for each sign)", of="work"),
    "pose_graph": Across("size of the graph (edges)"),
    "arm": Across("work (samples of the search)", of="work"),
}


def picture(name: str, runs: Mapping[str, Run]) -> bytes:
    """The SVG of an application, from the runs of one scenario and seed by policy."""
    across, default = ACROSS[name], runs[DEFAULT]
    shown = {i: x for i, known in default.known.items() if (x := across.value(known)) is not None}
    tasks, x = np.array(list(shown), dtype=int), np.array(list(shown.values()))
    times = {site: runs[site].times_ms()[tasks] / 1e3 for site in CONSTANTS}

    def paint(figure: Figure) -> None:
        axes = figure.add_subplot(xlabel=across.label, ylabel="response time (s)")
        for site in CONSTANTS:
            points(axes, x, times[site], site, gid=f"points-{site}", opacity=0.8)
            chosen = np.array([default.known[i].site == site for i in shown], dtype=bool)
            axes.plot(x[chosen], times[site][chosen], **RING, gid=f"chosen-{site}")
        every = np.concatenate(list(times.values()))
        if (answered := every[np.isfinite(every)]).size:
            scale_times(axes.set_yscale, axes.yaxis, answered)
        if axes.get_yscale() == "linear":
            axes.set_ylim(bottom=0)
        ring = Line2D([], [], **RING, label=f"chosen by {DEFAULT}")
        legend(figure, [*(_key(site) for site in (ONBOARD, CLOUD)), ring], columns=3)

    return render(paint).svg


def _key(site: str) -> Line2D:
    found = key(LOOKS[site], f"policy {site}")
    found.set_linestyle("")
    return found
