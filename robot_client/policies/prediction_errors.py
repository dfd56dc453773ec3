"""How wrong past predictions were, and how late a task may therefore be.

`learning/conformal.py` collects the errors; `hedge` and `objectives` read them.
"""

import math
from bisect import bisect_left
from dataclasses import dataclass

from offboard.robot_client.predictors.base import SIZE_MIN

ERRORS_MIN = 10  # with fewer errors, they are taken to be normal, and the spread counts as one of them
SPREADS_90 = 1.645  # standard deviations on each side that hold 90 % of the times, and above which 5 % are


@dataclass
class PredictionErrors:
    """How wrong the last predictions for one site were; a value that never changes.

    `scores`: the error of each prediction in units of `unit_s`, sorted. `usual_s`: the usual time of a task.
    `stopped`: the same of runs that were stopped late, until then; mostly a hedge had answered first.
    The methods return None while fewer than ERRORS_MIN errors are known, unless a spread helps.
    """

    scores: tuple[float, ...] = ()
    usual_s: float = 0.0
    stopped: tuple[float, ...] = ()

    def share_above(
        self, predicted_s: float, limit_s: float, spread_s: float | None = None, error_s: float = 0.0
    ) -> float | None:
        """The share of tasks with this prediction that should take longer than `limit_s`."""
        count = len(self.scores)
        if count < ERRORS_MIN:
            if not spread_s:
                return None
            scale_s = math.hypot(self._scale_s(predicted_s, spread_s), error_s)
            t = (limit_s - predicted_s) / scale_s
            return 0.5 * math.erfc(normal_of_student(t, count + 1) / math.sqrt(2.0))
        unit, margin_s = unit_s(predicted_s, self.usual_s), limit_s - predicted_s
        if error_s > 0.0:  # each past error may come with any error of this prediction
            of = error_s * math.sqrt(2.0)
            above = math.fsum([0.5 * math.erfc((margin_s - unit * score) / of) for score in self.scores])
        else:
            above = count - bisect_left(self.scores, margin_s / unit)
        # Never 0 or 1: a limit that no error has reached yet may still be missed.
        above += len(self.stopped)  # they might never have ended
        return (above + self._unseen(margin_s / unit)) / (count + len(self.stopped) + 1)

    @property
    def few(self) -> bool:
        return len(self.scores) < ERRORS_MIN

    def worst_s(self, predicted_s: float, error_s: float) -> float:
        """The time of a task with this prediction if it is as late as the latest one."""
        largest = max(0.0, self.scores[-1], *self.stopped[-1:])
        return predicted_s + widened_s(unit_s(predicted_s, self.usual_s) * largest, error_s)

    def _unseen(self, score: float) -> float:
        """How many further errors to expect above this score, if none was seen there.

        Half an error up to the size of the largest one, and beyond it less, with the square of the distance:
        so fast falls at least every tail that has a variance (Chebyshev's inequality).
        """
        largest = max(self.scores[-1], -self.scores[0])
        return 0.5 * (largest / score) ** 2 if score > largest else 0.5

    def half_90_s(self, predicted_s: float, spread_s: float, error_s: float = 0.0) -> float:
        """Half of the width of a 90 % interval while few errors are known."""
        scale_s = math.hypot(self._scale_s(predicted_s, spread_s), error_s)
        return student_90(len(self.scores) + 1) * scale_s

    def below(self, predicted_s: float, share: float, error_s: float = 0.0) -> float | None:
        """The time in seconds that this share of tasks with this prediction should stay below."""
        if len(self.scores) < ERRORS_MIN:
            return None
        scores = sorted(self.scores + self.stopped) if self.stopped else self.scores
        rank = min(len(scores), math.ceil(share * (len(scores) + 1))) - 1
        beyond_s = unit_s(predicted_s, self.usual_s) * scores[rank]
        return max(0.0, predicted_s + widened_s(beyond_s, error_s))

    def _scale_s(self, predicted_s: float, spread_s: float) -> float:
        """The root mean square of the errors and the spread."""
        unit = unit_s(predicted_s, self.usual_s)
        squares = math.fsum((unit * score) ** 2 for score in self.scores)
        return math.sqrt((squares + spread_s * spread_s) / (len(self.scores) + 1))


NO_ERRORS = PredictionErrors()


def student_90(freedom: int) -> float:
    """The 95 % quantile of Student's t, to 2 % from 2 degrees of freedom (Wallace 1959)."""
    z = SPREADS_90 * (8 * freedom + 3) / (8 * freedom + 1)
    return math.sqrt(freedom * math.expm1(z * z / freedom))


def normal_of_student(t: float, freedom: int) -> float:
    """The normal deviate that is as likely to be exceeded as this `t`, by the same approximation."""
    z = math.sqrt(freedom * math.log1p(t * t / freedom)) * (8 * freedom + 1) / (8 * freedom + 3)
    return math.copysign(z, t)


def unit_s(predicted_s: float, usual_s: float) -> float:
    """The unit of the errors: a part of the noise grows with the task, and a part does not."""
    unit = 0.5 * ((predicted_s if predicted_s > 0 else 0.0) + usual_s)
    return unit if unit > SIZE_MIN else 1.0  # errors in this unit must not leave the range of a float


def widened_s(beyond_s: float, error_s: float) -> float:
    """A distance from the prediction, moved up by what the prediction itself may be wrong by."""
    return beyond_s - abs(beyond_s) + math.hypot(beyond_s, SPREADS_90 * error_s)
