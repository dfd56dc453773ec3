"""Dynamic model averaging: three predictors of one site, weighted by how right each was recently."""

import math
from collections.abc import Sequence

from offboard.robot_client.predictors.adaptive import CLIP, ClippedLeastSquares, Kalman, Paced, Scale
from offboard.robot_client.predictors.base import Prediction, check_observation
from offboard.robot_client.predictors.features import Conditional, Gains
from offboard.robot_client.predictors.robust import TheilSen
from offboard.robot_client.sites.runner import UNMEASURED, Condition

SHARPNESS = 4.0  # weight of a model: exp(-SHARPNESS x its mean error in units of the average's own)
MEMORY = 0.9  # share of the mean error that is left after one more task
ERROR_MAX = 4.0  # the error of one task counts as at most this many errors of the average
START = 10  # first observations; their outliers are clipped at CLIP deviations from a robust line
START_CLIP_FROM = 5  # with fewer observations none counts as an outlier
EXCESS_RATE = 0.05  # of the mean of what was clipped
EXCESS_MAX = 8.0  # clips that count of it at most, because hedges bound the wait
FEARED = 20  # tasks without news after which it starts to fade: a site that is not slow is tried that often
FADING = 0.97  # factor with each further task

Three = tuple[float, float, float]  # a value of each model


class Average(Conditional):
    """The weighted mean of three models.

    Least squares learns the measured times. A Kalman filter and a line with a pace learn what is left without
    the measured features. The weights depend on the recent errors of the models: Raftery, Karny and Ettler,
    Online Prediction Under Model Uncertainty Via Dynamic Model Averaging (2010), with clipped absolute errors
    in place of densities, because no model can predict an outlier. The spread is the running error of the
    mean itself.

    Outliers among the first START observations are clipped at a robust line. The mean of what was clipped is
    added to every prediction, because such times will come again. It fades while the site is not used:
    otherwise bad luck at the start could exclude a site for ever.

    blind: ignore the measured features.
    """

    def __init__(self, window: int, seed: int = 0, *, blind: bool = False) -> None:
        self._window, self._seed, self._blind = window, seed, blind
        self._first: list[tuple[float, float, Condition]] = []
        self._forget()

    def _forget(self) -> None:
        """Start from nothing; the caller teaches what `_first` holds."""
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
        """The mean by shares; exact if all three agree."""
        (_, left_share, paced_share), (seen, left, paced) = self._shares, each
        return seen + left_share * (left - seen) + paced_share * (paced - seen)

    def _judge(self, each: Three, seconds: float) -> None:
        """Learn how far each model was off, and set the weights."""
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
        """An observation was clipped at `clip`, and was `beyond_s` larger."""
        excess = min(beyond_s, EXCESS_MAX * clip) if beyond_s > 0 else 0.0
        self._excess += EXCESS_RATE * (excess - self._excess)

    def _feared(self, ahead: int) -> float:
        """The mean of what was clipped, faded for `ahead` tasks without news."""
        return self._excess if ahead <= FEARED else self._excess * FADING ** (ahead - FEARED)

    def _learn_gains(self, size: float, rest: float, condition: Condition) -> None:
        """Learn the gains from the error of the Kalman filter, which uses them."""
        expected = self._left.expect(size) * self._gains.crowding(condition)
        if expected > 0:
            self._gains.learn(rest / expected, condition)


def _reach(first: Sequence[tuple[float, float, Condition]]) -> list[tuple[float, float]]:
    """The lowest and highest seconds of each observation that is no outlier."""
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
    """The average that ignores the measured features."""
    return Average(window, seed, blind=True)
