"""Dynamic model averaging: several predictors of one site, each believed as far as it was right of late."""

import math
from collections.abc import Sequence

from robot_client.predictors.adaptive import CLIP, ClippedLeastSquares, Kalman, Scale
from robot_client.predictors.base import Prediction, check_observation
from robot_client.predictors.features import Conditional, Gains
from robot_client.predictors.robust import TheilSen
from robot_client.runner import UNMEASURED, Condition

SHARPNESS = 4.0  # weight of a model: exp(-SHARPNESS x its mean error in units of the average's own)
MEMORY = 0.9  # of the mean error: so much of it is left after one more task
ERROR_MAX = 4.0  # one task's error counts as at most so many of the average's own
START = 10  # observations, of which none may lie further than CLIP deviations from a line that bears outliers
START_CLIP_FROM = 5  # fewer have no outliers
EXCESS_RATE = 0.05  # of the mean of what was clipped
EXCESS_MAX = 8.0  # clips that count of it, at most: hedges bound what is waited for


class Average(Conditional):
    """Least squares and Kalman filter, each with the measured features (unless `blind`) and without.

    The mean of their predictions, weighted by how small their errors were of late: Raftery, Karny and
    Ettler, Online Prediction Under Model Uncertainty Via Dynamic Model Averaging (2010), with clipped
    absolute errors in place of densities: an outlier is no model's fault. The models with features share
    one set of gains. The spread is the running error of the average itself.

    The first START observations are held to a line that bears outliers; what was clipped off any counts in
    the mean, as times do that nobody can foretell.
    """

    def __init__(self, window: int, seed: int = 0, *, blind: bool = False) -> None:
        self._window, self._seed, self._blind = window, seed, blind
        self._first: list[tuple[float, float, Condition]] = []
        self._forget()

    def _forget(self) -> None:
        """Begin anew, with what `_first` holds not yet learnt."""
        window, seed = self._window, self._seed
        self._plain = _models(window, seed)
        self._measured = () if self._blind else _models(window, seed)
        count = len(self._plain) + len(self._measured)
        self._errors = [0.0] * count
        self._weights = [1 / count] * count
        self._gains = Gains()
        self._scale = Scale()
        self._excess = 0.0

    @property
    def full(self) -> bool:
        return self._plain[0].full

    def __len__(self) -> int:
        return len(self._plain[0])

    def learn(self, size: float, seconds: float, condition: Condition = UNMEASURED) -> None:
        check_observation(size, seconds)
        if len(self._first) == START:
            self._learn(size, seconds, condition)
            return
        self._first.append((size, seconds, condition))
        self._forget()
        reach = _reach(self._first)
        for (size, seconds, condition), (low, high) in zip(self._first, reach, strict=True):
            self._learn(size, min(max(seconds, low), high), condition)
            self._exceed(seconds - high, high - low)

    def _learn(self, size: float, seconds: float, condition: Condition) -> None:
        if len(self):
            self._judge(self._each(size, condition), seconds)
        for plain in self._plain:
            plain.learn(size, seconds)
        if self._measured:
            rest = max(0.0, seconds - (condition.round_trip_s or 0.0))
            self._learn_gains(size, rest, condition)
            rest /= self._gains.crowding(condition)
            for measured in self._measured:
                measured.learn(size, rest)

    def predict(
        self,
        size: float,
        ahead: int = 1,  # noqa: ARG002
        condition: Condition = UNMEASURED,
    ) -> Prediction | None:
        if not len(self):
            return None
        return Prediction(
            self._mean(self._each(size, condition)) + self._excess,
            self._scale.deviation if self._scale.count > 1 else None,
        )

    def _each(self, size: float, condition: Condition) -> list[float]:
        """Of every model: those without features first."""
        found = [plain.expect(size) for plain in self._plain]
        if self._measured:
            trip_s, crowding = condition.round_trip_s or 0.0, self._gains.crowding(condition)
            for one in self._measured:
                rest = one.expect(size)
                found.append(trip_s + crowding * rest if rest > 0 else trip_s)
        return [seconds if seconds > 0 else 0.0 for seconds in found]

    def _mean(self, predicted: list[float]) -> float:
        first = predicted[0]  # exact where all agree
        return first + sum(
            [weight * (one - first) for weight, one in zip(self._weights, predicted, strict=True)]
        )

    def _judge(self, predicted: list[float], seconds: float) -> None:
        """How far each was off; the weights that follow."""
        unit = self._scale.deviation
        error, clip = seconds - self._mean(predicted), self._scale.clip
        self._exceed(error - clip, clip)
        self._scale.add(error)
        unit = unit or self._scale.deviation
        if not unit:
            return
        fresh = 1 - MEMORY
        self._errors = [
            MEMORY * before + fresh * min(abs(seconds - one) / unit, ERROR_MAX)
            for before, one in zip(self._errors, predicted, strict=True)
        ]
        least = min(self._errors)
        weights = [math.exp(SHARPNESS * (least - error)) for error in self._errors]
        total = sum(weights)
        self._weights = [weight / total for weight in weights]

    def _exceed(self, beyond_s: float, clip: float) -> None:
        """What was clipped at `clip` was so much more."""
        excess = min(max(0.0, beyond_s), EXCESS_MAX * clip)
        self._excess += EXCESS_RATE * (excess - self._excess)

    def _learn_gains(self, size: float, rest: float, condition: Condition) -> None:
        """From the error of the models that use them."""
        if not (condition.queue or condition.load) or not len(self._measured[0]):
            return
        expected = sum(max(0.0, one.expect(size)) for one in self._measured) / len(self._measured)
        expected *= self._gains.crowding(condition)
        if expected > 0:
            self._gains.learn(rest / expected, condition)


def _reach(first: Sequence[tuple[float, float, Condition]]) -> list[tuple[float, float]]:
    """Between what seconds each is no outlier; from START_CLIP_FROM observations on there may be some."""
    line = TheilSen(START)
    for size, seconds, _ in first:
        line.learn(size, seconds)
    found = []
    for size, _, _ in first:
        expected = line.predict(size)
        if expected is None or not expected.spread_s or len(first) < START_CLIP_FROM:
            found.append((0.0, math.inf))
        else:
            reach = CLIP * expected.spread_s
            found.append((max(0.0, expected.seconds - reach), max(0.0, expected.seconds + reach)))
    return found


def _models(window: int, seed: int) -> tuple[ClippedLeastSquares | Kalman, ...]:
    return ClippedLeastSquares(window, seed), Kalman(window, seed)


def blind_average(window: int, seed: int = 0) -> Average:
    """Least squares and Kalman filter on the size alone."""
    return Average(window, seed, blind=True)
