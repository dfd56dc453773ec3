"""Predictors that follow a site as it changes, and do not jump at a single outlier.

All limits are relative to the running error of the site, so that they fit tasks of 5 ms and of 50 s.
"""

import math

from offboard.robot_client.predictors.base import SIZE_MIN, Prediction, check_observation
from offboard.robot_client.predictors.least_squares import ROUNDING, RecursiveLeastSquares, checked_forgetting
from offboard.robot_client.predictors.window import WINDOW_MAX, checked_length

CLIP = 3.0  # an error counts as at most this many standard deviations of the running error
CLIP_FROM = 8  # observations before any is taken for an outlier
SCALE_RATE = 0.05  # weight of a new error in the running error, after the first 20 errors
PACE_RATE = 0.3  # how far the pace follows the ratio of measured to expected time
PACE_MAX = 2.0  # a larger ratio counts as this one
PACE_FAR = 100.0  # the largest pace; the smallest is its inverse
PACE_WINDOWS = 4  # memory of the line, in windows
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


class Paced:
    """A line times a pace: the speed of a site changes far sooner than how its times depend on size.

    On a logarithmic scale, the pace moves by PACE_RATE towards the ratio of measured to expected time, which
    counts as at most PACE_MAX. The line is learnt from times divided by the pace.
    """

    def __init__(self, window: int, seed: int = 0) -> None:
        self._line = ClippedLeastSquares(min(PACE_WINDOWS * checked_length(window), WINDOW_MAX), seed)
        self._pace = 1.0

    def expect(self, size: float) -> float:
        """The expected seconds, without a spread."""
        return self._pace * self._line.expect(size)

    def learn(self, size: float, seconds: float) -> None:
        if len(self._line) >= CLIP_FROM and (expected := self.expect(size)) > 0:
            ratio = min(max(seconds / expected, 1 / PACE_MAX), PACE_MAX)
            self._pace = min(max(self._pace * ratio**PACE_RATE, 1 / PACE_FAR), PACE_FAR)
        self._line.learn(size, seconds / self._pace)


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


class Kalman:
    """A dynamic linear model: level and slope are random walks, and observations have noise.

    West and Harrison, Bayesian Forecasting and Dynamic Models. The noise of the walks is a share of the
    measured noise, so that units do not matter. Innovations are clipped at CLIP running errors. After RUN
    innovations of the same sign beyond SIGNAL running errors, the last one is not clipped and the level
    becomes as uncertain as that innovation is large, so that a lasting change is learnt at once. It counts as
    at most GROWTH times the innovation before, because a large outlier after a small one is no change.
    The filter learns nothing about a site that is no longer used, so it needs probes.
    """

    LEVEL_NOISE = 0.1  # variance of a step of the level, as a share of the variance of the measurement
    SLOPE_NOISE = 0.01  # the same for the slope times the typical distance of a size from the first size
    NOISE_RATE = 0.04  # weight of a new task in the variance of the measurement
    SIGNAL, RUN = 2.0, 2

    def __init__(self, window: int, seed: int = 0) -> None:  # noqa: ARG002 - nothing is random
        self.window = checked_length(window)
        self._count = 0
        self._origin = 0.0  # the first size; the level is the time there
        self._level = self._slope = 0.0
        self._p00 = self._p01 = self._p11 = 0.0  # covariance of level and slope
        self._noise = 0.0
        self._reach = 0.0  # mean square distance of sizes from the origin
        self._scale = Scale()
        self._run = 0  # innovations of one sign beyond SIGNAL, with that sign
        self._last_error = 0.0

    @property
    def full(self) -> bool:
        return self._count >= self.window

    def __len__(self) -> int:
        return self._count

    def learn(self, size: float, seconds: float) -> None:
        check_observation(size, seconds)
        if self._count < self.window:
            self._count += 1
        if self._scale.count == 0 and self._count == 1:
            self._origin, self._level = size, seconds
            self._noise = (0.3 * seconds) ** 2
            self._p00 = self._noise
            return
        x = size - self._origin
        if abs(x) <= SIZE_MIN:
            x = 0.0
        self._see(x)
        expected = self._level + self._slope * x
        error = seconds - expected
        clip, deviation = self._scale.clip, self._scale.deviation
        self._scale.add(error)
        most, self._last_error = GROWTH * abs(self._last_error), error
        if self._watch(error, deviation):
            error = min(max(error, -most), most)
            self._p00 += error * error
        elif error > clip:
            error = clip
        elif error < -clip:
            error = -clip
        self._step(x, error)

    def expect(self, size: float) -> float:
        """The expected seconds, without a spread."""
        return self._level + self._slope * (size - self._origin)

    def predict(self, size: float, ahead: int = 1) -> Prediction | None:  # noqa: ARG002
        if not self._count:
            return None
        return Prediction(self.expect(size), self._scale.deviation if self._scale.count > 1 else None)

    def _see(self, x: float) -> None:
        """Follow the typical distance of sizes, and set the uncertainty of the slope at the first one."""
        rate = max(1 / self._count, 1 / self.window)
        first = self._reach == 0
        self._reach += rate * (x * x - self._reach)
        if first and self._reach > 0:
            self._p11 = self._noise / self._reach

    def _watch(self, error: float, deviation: float) -> bool:
        """Whether RUN innovations in a row were beyond SIGNAL on the same side, which is a change."""
        if self._scale.count <= CLIP_FROM or abs(error) <= self.SIGNAL * deviation:
            self._run = 0
            return False
        sign = 1 if error > 0 else -1
        self._run = self._run + sign if self._run * sign > 0 else sign
        return abs(self._run) >= self.RUN

    def _step(self, x: float, error: float) -> None:
        """Predict and update (Kalman 1960), in the symmetric form."""
        self._p00 += self.LEVEL_NOISE * self._noise
        if self._reach > 0:
            self._p11 += self.SLOPE_NOISE * self._noise / self._reach
        c0, c1 = self._p00 + self._p01 * x, self._p01 + self._p11 * x
        variance = c0 + c1 * x
        total = variance + self._noise
        if total > 0 and math.isfinite(total):
            k0, k1 = c0 / total, c1 / total
            self._level += k0 * error
            self._slope += k1 * error
            self._p00 = max(0.0, self._p00 - k0 * c0)
            self._p01 -= k0 * c1
            self._p11 = max(0.0, self._p11 - k1 * c1)
        # The part that the model does not explain is noise of the measurement.
        unexplained = max(error * error - variance, 0.0)
        self._noise += max(1 / self._count, self.NOISE_RATE) * (unexplained - self._noise)
