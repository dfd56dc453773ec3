"""The numbers that the charts of a report show.

How they are drawn is left to `charts.py`.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from offboard.loadgen.table.confidence_intervals import Blocks
from offboard.loadgen.table.measured_rows import Column, Rows
from offboard.loadgen.table.predictor_evaluation import Evaluation
from offboard.loadgen.table.table_two_figures import Score, Scored, Sides

POINTS_MAX = 1000  # points of one series that are drawn; more make the page large and show nothing new
SHARE_TASKS = 20  # the share of the cloud is taken over this number of tasks,
SHARE_PARTS = 50  # or over one part in 50 of a long run; over half of a short run

S = TypeVar("S", float, Column)
Picks = npt.NDArray[np.intp]


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


@dataclass(frozen=True, slots=True)
class Decisions:
    """What `policy` decided: number, seconds and site of the tasks to draw, in order.

    - `of`: the number of all tasks.
    - `share_percent`: the share of the cloud among the latest `over` tasks.
    - `best_percent`: the same share for the oracle; None where only the time of one site is known.
    """

    policy: str
    number: Picks
    seconds: Column
    to_cloud: Sides
    share_percent: Column
    best_percent: Column | None
    over: int
    of: int


@dataclass(frozen=True, slots=True)
class Interval:
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


def decisions(
    policy: str, seconds: Column, to_cloud: Sides, *, first: int, seed: int, best: Sides | None = None
) -> Decisions:
    """The chart of decisions.

    Tasks are numbered from `first`. `best` says which tasks were really faster in the cloud.
    """
    count = len(seconds)
    over = min(max(SHARE_TASKS, count // SHARE_PARTS), max(1, count // 2))
    picks = thin(count, seed)
    return Decisions(
        policy=policy,
        number=picks + first,
        seconds=seconds[picks],
        to_cloud=to_cloud[picks],
        share_percent=share_percent(to_cloud, over)[picks],
        best_percent=None if best is None else share_percent(best, over)[picks],
        over=over,
        of=count,
    )


def share_percent(sides: Sides, over: int) -> Column:
    """For each task, the share of the cloud among the latest `over` tasks; NaN before there are that many."""
    total = np.cumsum(sides, dtype=np.float64)
    total[over:] -= total[:-over].copy()
    total[: over - 1] = np.nan
    found: Column = 100 * total / over
    return found


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
        interval = None if scored is None else _accuracy_interval(scored, seed)
        if interval is not None:
            found[line.window] = interval
    return found


def thin(count: int, seed: int) -> Picks:
    """Which of `count` points to draw, in order: a random one from each of `POINTS_MAX` equal parts."""
    if count <= POINTS_MAX:
        return np.arange(count)
    edges = np.linspace(0, count, POINTS_MAX + 1).astype(np.intp)
    return np.random.default_rng(seed).integers(edges[:-1], edges[1:])


def _accuracy_interval(scored: Scored, seed: int) -> Interval | None:
    """The interval of the accuracy; None if there are too few rows."""

    def accuracy(picks: Picks) -> dict[str, Column]:
        return {"accuracy_percent": 100 * right[picks].mean(-1)}

    spent_s = np.where(scored.to_cloud, scored.cloud_s, scored.onboard_s)
    right = spent_s == np.minimum(scored.onboard_s, scored.cloud_s)
    low, high = Blocks(len(right), seed=seed).intervals(accuracy)
    return Interval(low["accuracy_percent"], high["accuracy_percent"]) if low else None
