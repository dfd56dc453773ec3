"""The numbers that the charts of a report show.

How they are drawn is left to `charts.py`.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np

from offboard.loadgen.table.confidence_intervals import Blocks, Picks
from offboard.loadgen.table.measured_rows import Column, Rows
from offboard.loadgen.table.table_two import Evaluation
from offboard.loadgen.table.table_two_figures import Score, Sides

POINTS_MAX = 1000  # points of one series that are drawn; more make the page large and show nothing new

S = TypeVar("S", float, Column)


@dataclass(frozen=True, slots=True)
class Line:
    """Seconds as a linear function of size, through (`mean_size`, `mean_seconds`)."""

    slope: float
    mean_size: float
    mean_seconds: float

    def at(self, size: S) -> S:
        return self.mean_seconds + self.slope * (size - self.mean_size)


@dataclass(frozen=True, slots=True)
class Times:
    """The rows to draw, and the lines that fit all rows, from the lowest to the highest size.

    `crossing` is the size at which the lines cross; None means that they are parallel.
    """

    rows: Rows
    low: float
    high: float
    onboard: Line
    cloud: Line
    crossing: float | None

    @property
    def crossing_inside(self) -> bool:
        return self.crossing is not None and self.low <= self.crossing <= self.high


class Interval(NamedTuple):
    """The 95 % interval of the accuracy with one window, in percent."""

    low: float
    high: float


@dataclass(frozen=True, slots=True)
class Accuracies:
    """The scores of all predictors, the intervals of the first one by window, and the constant policies."""

    scores: Sequence[Score]
    intervals: Mapping[str, Interval]
    rules: Sequence[Score]


def times(rows: Rows, seed: int) -> Times:
    """The chart of execution times; there must be at least one row."""
    picks = thin(len(rows), seed)
    onboard, cloud = fit(rows.size, rows.onboard_s), fit(rows.size, rows.cloud_s)
    shown = Rows(rows.size[picks], rows.onboard_s[picks], rows.cloud_s[picks])
    return Times(
        rows=shown,
        low=float(rows.size.min()),
        high=float(rows.size.max()),
        onboard=onboard,
        cloud=cloud,
        crossing=crossing(onboard, cloud),
    )


def fit(size: Column, seconds: Column) -> Line:
    """The least-squares line; its slope is 0 if all sizes are equal."""
    mean_size, mean_seconds = float(size.mean()), float(seconds.mean())
    if np.ptp(size) == 0:
        return Line(0.0, float(size[0]), mean_seconds)
    d = size - mean_size
    scale = np.abs(d).max()  # no square underflows
    d /= scale
    return Line(float(d @ (seconds - mean_seconds) / (d @ d) / scale), mean_size, mean_seconds)


def crossing(onboard: Line, cloud: Line) -> float | None:
    """The size at which two lines over the same sizes cross; None if they are parallel."""
    slope = onboard.slope - cloud.slope
    if slope == 0:
        return None
    found = onboard.mean_size + (cloud.mean_seconds - onboard.mean_seconds) / slope
    return found if np.isfinite(found) else None


def ecdf(seconds: Column) -> tuple[Column, Column]:
    """Sorted times, and the percentage of tasks that took at most this time; the first step starts at 0 %."""
    values = np.sort(seconds)
    ranks = np.unique(np.linspace(0, len(values) - 1, min(len(values), POINTS_MAX)).round().astype(np.intp))
    return np.append(values[0], values[ranks]), np.append(0.0, 100 * (ranks + 1) / len(values))


def accuracy_intervals(
    evaluation: Evaluation, scores: Iterable[Score], feedback: str, seed: int
) -> dict[str, Interval]:
    """The interval of each score, by window, from the same resamples as in `loadgen table`."""
    found: dict[str, Interval] = {}
    for line in scores:
        scored = evaluation.predictions(line.predictor, line.window, feedback)
        low, high = (None, None) if scored is None else _accuracy_interval(scored.right, seed)
        if low is not None and high is not None:
            found[line.window] = Interval(low, high)
    return found


def _accuracy_interval(right: Sides, seed: int) -> tuple[float | None, float | None]:
    return Blocks(len(right), seed=seed).interval(lambda picks: 100 * right[picks].mean(-1))


def thin(count: int, seed: int) -> Picks:
    """Which of `count` points to draw, in order: a random one from each of `POINTS_MAX` equal parts."""
    if count <= POINTS_MAX:
        return np.arange(count)
    edges = np.linspace(0, count, POINTS_MAX + 1).astype(np.intp)
    return np.random.default_rng(seed).integers(edges[:-1], edges[1:])
