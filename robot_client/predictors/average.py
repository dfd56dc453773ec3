"""Dynamic model averaging: three predictors of one site, each believed as far as it was right of late."""

import math
from collections.abc import Sequence

from offboard.robot_client.predictors.adaptive import CLIP, ClippedLeastSquares, Kalman, Paced, Scale
from offboard.robot_client.predictors.base import Prediction, check_observation
from offboard.robot_client.predictors.features import Conditional, Gains
from offboard.robot_client.predictors.robust import TheilSen
from offboard.robot_client.sites.runner import UNMEASURED, Condition

SHARPNESS = 4.0  # weight of a model: exp(-SHARPNESS x its mean error in units of the average's own)
MEMORY = 0.9  # of the mean error: so much of it is left after one more task
ERROR_MAX = 4.0  # one task's error counts as at most so many of the average's own
START = 10  # observations, of which none may lie further than CLIP deviations from a line that bears outliers
START_CLIP_FROM = 5  # fewer have no outliers
EXCESS_RATE = 0.05  # of the mean of what was clipped
EXCESS_MAX = 8.0  # clips that count of it, at most: hedges bound what is waited for
FEARED = 20  # tasks without news that it outlasts: so often a site is tried that is not slow
FADING = 0.97  # with each one more

Three = tuple[float, float, float]  # a value of each model


class Average(Conditional):
    """Least squares on what is seen; a Kalman filter and a line at a pace on what is left without features.

    The features are those that were measured. The mean of the models' predictions is weighted by how small
    their errors were of late: Raftery, Karny and Ettler, Online Prediction Under Model Uncertainty Via
    Dynamic Model Averaging (2010), with clipped absolute errors in place of densities: an outlier is no
    model's fault. The spread is the running error of the average itself. `blind`: the features are not
    looked at.

    The first START observations are held to a line that bears outliers; what was clipped off any counts in
    the mean, as times do that nobody can foretell. Where no news come that fades: bad luck at the start would
    else keep a site from ever being chosen again.
    """

    def __init__(self, window: int, seed: int = 0, *, blind: bool = False) -> None:
        self._window, self._seed, self._blind = window, seed, blind
        self._first: list[tuple[float, float, Condition]] = []
        self._forget()

    def _forget(self) -> None:
        """Begin anew, with what `_first` holds not yet learnt."""
        self._seen = ClippedLeastSquares(self._window, self._seed)
        self._left = Kalman(self._window, self._seed)
        self._paced = Paced(self._window, self._seed)
        self._errors: Three = (0.0, 0.0, 0.0)  # of the models, in units of the average's own
        self._shares: Three = (1 / 3, 1 / 3, 1 / 3)  # of the models in the mean
        self._gains = Gains()
        self._scale = Scale()
        self._excess = 0.0

    @property
    def full(self) -> bool:
        return self._seen.full

    def __len__(self) -> int:
        return len(self._seen)

    def learn(self, size: float, seconds: float, condition: Condition = UNMEASURED, ahead: int = 1) -> None:
        check_observation(size, seconds)
        if self._blind:
            condition = UNMEASURED
        if len(self._first) == START:
            self._excess = self._feared(ahead)
            self._learn(size, seconds, condition)
            return
        self._first.append((size, seconds, condition))
        self._forget()
        reach = _reach(self._first)
        for (size, seconds, condition), (low, high) in zip(self._first, reach, strict=True):
            self._learn(size, min(max(seconds, low), high), condition)
            self._exceed(seconds - high, high - low)

    def _learn(self, size: float, seconds: float, condition: Condition) -> None:
        if len(self._seen):
            self._judge(self._each(size, condition), seconds)
        self._seen.learn(size, seconds)
        rest = max(0.0, seconds - (condition.round_trip_s or 0.0))
        if (condition.queue or condition.load) and len(self._left):
            self._learn_gains(size, rest, condition)
        rest /= self._gains.crowding(condition)
        self._left.learn(size, rest)
        self._paced.learn(size, rest)

    def predict(
        self,
        size: float,
        ahead: int = 1,
        condition: Condition = UNMEASURED,
    ) -> Prediction | None:
        if not self._first:
            return None
        each = self._each(size, UNMEASURED if self._blind else condition)
        return Prediction(
            self._mean(each) + self._feared(ahead),
            self._scale.deviation if self._scale.count > 1 else None,
        )

    def _each(self, size: float, condition: Condition) -> Three:
        """What each of the models expects."""
        seen, left, paced = self._seen.expect(size), self._left.expect(size), self._paced.expect(size)
        way, crowding = condition.round_trip_s or 0.0, self._gains.crowding(condition)
        return (
            seen if seen > 0 else 0.0,
            way + crowding * left if left > 0 else way,
            way + crowding * paced if paced > 0 else way,
        )

    def _mean(self, each: Three) -> float:
        """By their shares; to the bit what they say where all say the same."""
        (_, left_share, paced_share), (seen, left, paced) = self._shares, each
        return seen + left_share * (left - seen) + paced_share * (paced - seen)

    def _judge(self, each: Three, seconds: float) -> None:
        """How far each was off; the weights that follow."""
        scale = self._scale
        unit, clip = scale.deviation, scale.clip
        error = seconds - self._mean(each)
        self._exceed(error - clip, clip)
        scale.add(error)
        unit = unit or scale.deviation
        if not unit:
            return
        (a, b, c), (x, y, z) = each, self._errors
        x, y, z = self._errors = (
            MEMORY * x + (1 - MEMORY) * min(abs(seconds - a) / unit, ERROR_MAX),
            MEMORY * y + (1 - MEMORY) * min(abs(seconds - b) / unit, ERROR_MAX),
            MEMORY * z + (1 - MEMORY) * min(abs(seconds - c) / unit, ERROR_MAX),
        )
        least = min(x, y, z)  # so that one weight is 1, and their sum never 0
        exp = math.exp
        x, y, z = exp(SHARPNESS * (least - x)), exp(SHARPNESS * (least - y)), exp(SHARPNESS * (least - z))
        self._shares = x / (x + y + z), y / (x + y + z), z / (x + y + z)

    def _exceed(self, beyond_s: float, clip: float) -> None:
        """What was clipped at `clip` was so much more."""
        excess = min(beyond_s, EXCESS_MAX * clip) if beyond_s > 0 else 0.0
        self._excess += EXCESS_RATE * (excess - self._excess)

    def _feared(self, ahead: int) -> float:
        """What counts of what was clipped, `ahead` tasks after the last one learnt."""
        return self._excess if ahead <= FEARED else self._excess * FADING ** (ahead - FEARED)

    def _learn_gains(self, size: float, rest: float, condition: Condition) -> None:
        """From the error of the model that uses them."""
        expected = self._left.expect(size) * self._gains.crowding(condition)
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


def blind_average(window: int, seed: int = 0) -> Average:
    """Least squares and Kalman filter on the size alone."""
    return Average(window, seed, blind=True)
