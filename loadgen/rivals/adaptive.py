"""Predictors that follow a site as it changes, and do not jump at a single outlier.

All limits are relative to the running error of the site, so that they fit tasks of 5 ms and of 50 s.
"""

import math

from offboard.loadgen.rivals.recursive import ROUNDING, RecursiveLeastSquares, checked_forgetting
from offboard.robot_client.predictors.base import SIZE_MIN, Prediction, check_observation
from offboard.robot_client.predictors.window import checked_length

CLIP = 3.0  # an error counts as at most this many standard deviations of the running error
CLIP_FROM = 8  # observations before any is taken for an outlier
SCALE_RATE = 0.05  # weight of a new error in the running error, after the first 20 errors
NORMAL = math.sqrt(math.pi / 2)  # standard deviation divided by mean absolute error, for normal errors
GROWTH = 2.0  # an error counts as at most this many times the clip, or the error before


class Scale:
    """Running standard deviation of errors, computed from their mean absolute value as for normal errors.

    An error counts as at most GROWTH times `clip`. One outlier then does not make the next one look normal,
    while a lasting change doubles the scale within a few tasks. With squared errors, one outlier in 30 tasks
    would make the scale grow without end.

    clip: the largest error that counts in full; infinite while few errors are known, or all were 0.
    """

    __slots__ = ("_mean", "clip", "count", "deviation")

    def __init__(self) -> None:
        self.count = 0
        self.deviation = 0.0
        self.clip = math.inf
        self._mean = 0.0

    def add(self, error: float) -> None:
        error, most = abs(error), GROWTH * self.clip
        if error > most:
            error = most
        self.count += 1
        rate = 1 / self.count if self.count * SCALE_RATE < 1 else SCALE_RATE
        self._mean += rate * (error - self._mean)
        self.deviation = NORMAL * self._mean
        if self.count >= CLIP_FROM and self._mean:
            self.clip = CLIP * self.deviation


class ClippedLeastSquares:
    """Least squares with decaying weights, where no error counts as more than CLIP running errors.

    An observation further away is learnt as if it lay at that limit (Huber's psi as a one-step weight).
    The spread is the running error of predictions for observations that were not known yet.

    forgetting: the factor by which a weight decays with each execution; None is 1 - 1 / window.
    """

    def __init__(self, window: int, seed: int = 0, forgetting: float | None = None) -> None:  # noqa: ARG002
        self.window = checked_length(window)
        self.forgetting = checked_forgetting(window, forgetting)
        self._count = 0  # stops at the window
        self._weight = self._size = self._seconds = self._sdd = self._sdt = self._slope = 0.0
        self._scale = Scale()

    @property
    def full(self) -> bool:
        return self._count == self.window

    def __len__(self) -> int:
        return self._count

    def expect(self, size: float) -> float:
        """The expected seconds, without a spread."""
        return self._seconds + self._slope * (size - self._size)

    def predict(self, size: float, ahead: int = 1) -> Prediction | None:  # noqa: ARG002
        if not self._count:
            return None
        return Prediction(self.expect(size), self._scale.deviation if self._scale.count > 1 else None)

    def learn(self, size: float, seconds: float) -> None:
        """The centred sums of West (1979), as `RecursiveLeastSquares`."""
        check_observation(size, seconds)
        scale = self._scale
        if self._count:
            expected = self.expect(size)
            error, clip = seconds - expected, scale.clip
            scale.add(error)
            if error > clip:
                seconds = expected + clip
            elif error < -clip:
                seconds = max(0.0, expected - clip)
        if self._count < self.window:
            self._count += 1
        faded = self.forgetting * self._weight
        weight = self._weight = faded + 1
        d, t = size - self._size, seconds - self._seconds
        self._size += d / weight
        self._seconds += t / weight
        least = max(ROUNDING * size, SIZE_MIN)
        if -least <= d <= least:  # else a run of one size would fade all sums but that of its rounding
            d = 0.0
        share = faded / weight
        self._sdd = self.forgetting * self._sdd + share * d * d
        self._sdt = self.forgetting * self._sdt + share * d * t
        self._slope = self._sdt / self._sdd if self._sdd > weight * least * least else 0.0


class BayesianLeastSquares(RecursiveLeastSquares):
    """Bayesian linear regression with unknown noise. By default it forgets nothing.

    The prior of the slope is normal around 0 and weighs PRIOR observations; level and noise have no prior
    (Gelman et al., Bayesian Data Analysis, chapter 14). `error_s` is the posterior standard deviation of the
    mean time at this size, which bandit policies use to explore.
    """

    PRIOR = 1.0

    def __init__(self, window: int, seed: int = 0, forgetting: float | None = None) -> None:
        super().__init__(window, seed, 1.0 if forgetting is None else forgetting)

    def predict(self, size: float, ahead: int = 1) -> Prediction | None:  # noqa: ARG002
        if not self._count:
            return None
        ridge = self.PRIOR * self._sdd / self._weight  # in the units of the sizes
        least = max(SIZE_MIN, ROUNDING * self._size.value)
        known = self._sdd > self._weight * least * least
        slope = self._sdt / (self._sdd + ridge) if known else 0.0
        offset = self._size.offset(size)
        spread = self._spread(slope)
        error = None
        if spread is not None:
            leverage = offset * offset / (self._sdd + ridge) if known else 0.0
            error = spread * math.sqrt(1 / self._weight + leverage)
            if not math.isfinite(error):
                error = None
        return Prediction(self._seconds.value + slope * offset, spread, error)
