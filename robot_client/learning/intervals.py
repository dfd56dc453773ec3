"""Adaptive conformal intervals: bounds around a prediction that hold what they say, whatever the predictor.

Gibbs and Candès, Adaptive Conformal Inference Under Distribution Shift (2021): the share of errors that the
interval leaves out grows after one that it held and shrinks after one that it missed, so that the realised
share stays at what was asked for. Of all intervals that hold so many of the last errors it is the shortest:
times are skewed.
"""

import math
import operator
from bisect import bisect_left, insort
from collections import deque
from typing import NamedTuple

COVERAGE = 0.9
OUTSIDE = 1 - COVERAGE
OUTSIDE_MIN, OUTSIDE_MAX = -0.1, 0.5  # below 0: wider than all that was seen
SCORES_MAX = 100  # errors remembered
SCORES_MIN = 10  # before so many the spread alone tells
RATE = 0.03  # of the adaption
TAIL = 0.2  # of the errors: the largest, from which one tells how long a late task will still be
BEYOND = 0.25  # of the distance from the median to the largest error: so much later nothing was ever
NORMAL_90 = 1.645  # standard deviations on each side that hold 90 %, on one side 95 %
USUAL_RATE = 0.05


class Conformal:
    """The errors of one site's predictions, in units that grow with the predicted time.

    The unit is the mean of this prediction and of the usual one: part of the noise grows with the task, part
    does not.
    """

    def __init__(self) -> None:
        self._order: deque[float] = deque()
        self._sorted: list[float] = []
        self._usual_s = 0.0
        self._count = 0
        self._outside = OUTSIDE
        self._ends: tuple[float, float] | None = None  # scores between which the next one should be
        self._tail: _Tail | None = None

    @property
    def known(self) -> bool:
        """Whether the errors tell, and not the spread alone."""
        return len(self._sorted) >= SCORES_MIN

    def learn(self, predicted_s: float, seconds: float) -> None:
        """Take what came of a prediction."""
        if self._count:
            score = (seconds - predicted_s) / self._unit(predicted_s)
            if len(self._sorted) >= SCORES_MIN:
                low, high = self._ends or self._interval()
                self._adapt(missed=not low <= score <= high)
            self._add(score)
        self._count = min(self._count + 1, SCORES_MAX)
        self._usual_s += max(1 / self._count, USUAL_RATE) * (max(seconds, predicted_s) - self._usual_s)

    def miss(self) -> None:
        """A run was given up past the upper end: by how much it would have missed is not known."""
        if self.known:
            self._adapt(missed=True)

    def interval(self, predicted_s: float, spread_s: float | None) -> tuple[float, float] | None:
        """Lower and upper end of the COVERAGE interval; None while nothing tells."""
        if len(self._sorted) < SCORES_MIN:
            if spread_s is None:
                return None
            return max(0.0, predicted_s - NORMAL_90 * spread_s), predicted_s + NORMAL_90 * spread_s
        unit, (low, high) = self._unit(predicted_s), self._ends or self._interval()
        low_s = predicted_s + unit * low if low < 0 else predicted_s
        high_s = predicted_s + unit * high if high > 0 else predicted_s
        return (low_s if low_s > 0 else 0.0), (high_s if high_s > 0 else 0.0)

    def overdue(self, predicted_s: float, worth_s: float) -> float | None:
        """The time from which on a task so predicted is expected to need more than `worth_s` still.

        None while too few errors are known.
        """
        ordered, count = self._sorted, len(self._sorted)
        if count < SCORES_MIN:
            return None
        unit, last = self._unit(predicted_s), ordered[-1]
        first = count - round(TAIL * count)
        score = last + BEYOND * (last - ordered[count // 2])  # who is later than that may never come
        if unit * (last - ordered[first]) > worth_s:  # else none of them was so much longer than another
            if self._tail is None:
                self._tail = _tail(ordered[first:])
            if unit * self._tail.beyond > worth_s:
                score = self._tail.slowest
        return max(0.0, predicted_s + unit * score)

    def share_above(self, predicted_s: float, limit_s: float) -> float | None:
        """The share of errors with which a task so predicted would exceed `limit_s`; None: too few known."""
        count = len(self._sorted)
        if count < SCORES_MIN:
            return None
        score = (limit_s - predicted_s) / self._unit(predicted_s)
        # A limit beyond all that was seen is still not certain.
        return (count - bisect_left(self._sorted, score) + 0.5) / (count + 1)

    def below(self, predicted_s: float, share: float) -> float | None:
        """The time that this share of tasks so predicted stays below; None: too few known."""
        count = len(self._sorted)
        if count < SCORES_MIN:
            return None
        rank = min(count - 1, math.ceil(share * (count + 1)) - 1)
        return max(0.0, predicted_s + self._unit(predicted_s) * self._sorted[rank])

    def _unit(self, predicted_s: float) -> float:
        return 0.5 * ((predicted_s if predicted_s > 0 else 0.0) + self._usual_s) or 1.0

    def _adapt(self, *, missed: bool) -> None:
        outside = self._outside + RATE * (OUTSIDE - missed)
        self._outside = min(OUTSIDE_MAX, max(OUTSIDE_MIN, outside))
        self._ends = None

    def _add(self, score: float) -> None:
        ordered = self._sorted
        if len(self._order) == SCORES_MAX:
            del ordered[bisect_left(ordered, self._order.popleft())]
        self._order.append(score)
        insort(ordered, score)
        self._ends = self._tail = None

    def _interval(self) -> tuple[float, float]:
        self._ends = _shortest(self._sorted, 1 - self._outside)
        return self._ends


class _Tail(NamedTuple):
    """Of the largest errors the one beyond which the others were so much longer in the mean as beyond no
    other."""

    slowest: float
    beyond: float


def _tail(largest: list[float]) -> _Tail:
    """Of at least two errors in order."""
    slowest = total = largest.pop()
    beyond = -math.inf
    for n, score in enumerate(reversed(largest), 1):
        longer = total / n - score
        if longer >= beyond:
            slowest, beyond = score, longer
        total += score
    return _Tail(slowest, beyond)


def _shortest(ordered: list[float], share: float) -> tuple[float, float]:
    """Ends of the shortest window that holds this share, with the finite-sample rank of conformal prediction.

    More than all that was seen is all of it, and as much of its range beyond on both sides.
    """
    count = len(ordered)
    held = math.ceil(share * (count + 1))
    if held >= count:
        beyond = (share * (count + 1) / count - 1) * (ordered[-1] - ordered[0])
        return ordered[0] - max(0.0, beyond), ordered[-1] + max(0.0, beyond)
    widths = list(map(operator.sub, ordered[held - 1 :], ordered))
    first = widths.index(min(widths))
    return ordered[first], ordered[first + held - 1]
