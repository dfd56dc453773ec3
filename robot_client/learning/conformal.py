"""Adaptive conformal intervals: they hold 90 % of the measured times, whatever the predictor.

What a policy reads from the errors, such as when a task is overdue, is in `policies/prediction_errors.py`.
"""

import math
import operator
from bisect import bisect_left, insort
from collections import deque

from offboard.robot_client.policies.prediction_errors import ERRORS_MIN, SPREADS_90, PredictionErrors, unit_s
from offboard.robot_client.predictors.line import RunningMean

COVERAGE = 0.9  # share of the times that an interval should hold
ERRORS_MAX = 100  # the last ones
STEP = 0.05  # by which one time that is outside makes the interval wider, as a share of the errors


class Conformal:
    """Learns the errors of the predictions for one site, and adapts its interval to them.

    After Gibbs and Candès, Adaptive Conformal Inference Under Distribution Shift (2021): the interval is made
    narrower after a time that it held and wider after a time that it missed, so that the share that it holds
    stays at COVERAGE. Times are skewed, so the interval is the shortest one that holds enough of the last
    errors, not a symmetric one.
    """

    def __init__(self) -> None:
        self._order: deque[float] = deque()
        self._stopped: deque[tuple[int, float]] = deque(maxlen=ERRORS_MAX)  # with the runs learnt before each
        self._sorted: list[float] = []
        self._usual_s = RunningMean()
        self._outside = 1 - COVERAGE  # the share of errors that the interval leaves out
        self._ends: tuple[float, float] | None = None  # of the interval, as scores
        self._errors: PredictionErrors | None = None

    @property
    def errors(self) -> PredictionErrors:
        """The errors until now, as a value; made again only after something was learnt."""
        if self._errors is None:
            while self._stopped and self._stopped[0][0] <= self._usual_s.count - ERRORS_MAX:
                self._stopped.popleft()
            stopped = tuple(sorted([score for _, score in self._stopped])) if self._stopped else ()
            self._errors = PredictionErrors(tuple(self._sorted), self._usual_s.value, stopped)
        return self._errors

    def learn(self, predicted_s: float, seconds: float) -> None:
        """Learn from a prediction and the time that the task then took."""
        if self._usual_s.count:
            score = (seconds - predicted_s) / unit_s(predicted_s, self._usual_s.value)
            if len(self._sorted) >= ERRORS_MIN:
                low, high = self._ends or self._interval()
                self._adapt(missed=not low <= score <= high)
            self._add(score)
        self._usual_s.add(max(seconds, predicted_s))
        self._errors = None

    def miss(self, predicted_s: float, seconds: float) -> None:
        """Learn that a task was stopped after the upper end; how late it would have been is unknown."""
        if len(self._sorted) >= ERRORS_MIN:
            self._adapt(missed=True)
            score = (seconds - predicted_s) / unit_s(predicted_s, self._usual_s.value)
            self._stopped.append((self._usual_s.count, score))
            self._errors = None

    def interval(
        self, predicted_s: float, spread_s: float | None, error_s: float = 0.0
    ) -> tuple[float, float] | None:
        """Lower and upper end in seconds; None while too few errors are known and there is no spread.

        `error_s`: the standard error of this prediction. Past errors do not hold the error of a prediction
        for a size far from all sizes that were learned.
        """
        if len(self._sorted) < ERRORS_MIN:
            if spread_s is None:
                return None
            half_s = self.errors.half_90_s(predicted_s, spread_s, error_s)
            return max(0.0, predicted_s - half_s), predicted_s + half_s
        unit, (low, high) = unit_s(predicted_s, self._usual_s.value), self._ends or self._interval()
        more_s = SPREADS_90 * error_s
        low_s = predicted_s - math.hypot(unit * min(0.0, low), more_s)
        high_s = predicted_s + math.hypot(unit * max(0.0, high), more_s)
        return (low_s if low_s > 0 else 0.0), (high_s if high_s > 0 else 0.0)

    def _adapt(self, *, missed: bool) -> None:
        outside = self._outside + STEP * (1 - COVERAGE - missed)  # below 0: wider than all errors seen
        self._outside = min(COVERAGE, max(COVERAGE - 1, outside))
        self._ends = None

    def _add(self, score: float) -> None:
        ordered = self._sorted
        if len(self._order) == ERRORS_MAX:
            del ordered[bisect_left(ordered, self._order.popleft())]
        self._order.append(score)
        insort(ordered, score)
        self._ends = None

    def _interval(self) -> tuple[float, float]:
        self._ends = _shortest(self._sorted, 1 - self._outside)
        return self._ends


def _shortest(ordered: list[float], share: float) -> tuple[float, float]:
    """Ends of the shortest window that holds this share, by the finite-sample rank of conformal prediction.

    If the share is more than all errors seen, the window is wider than all of them, by the same amount on
    both sides.
    """
    count = len(ordered)
    held = math.ceil(share * (count + 1))
    if held >= count:
        beyond = (share * (count + 1) / count - 1) * (ordered[-1] - ordered[0])
        return ordered[0] - max(0.0, beyond), ordered[-1] + max(0.0, beyond)
    widths = list(map(operator.sub, ordered[held - 1 :], ordered))
    first = widths.index(min(widths))
    return ordered[first], ordered[first + held - 1]
