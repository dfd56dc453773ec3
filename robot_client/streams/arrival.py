"""How long the chunks of one site take to arrive.

What is asked when is in `asking`.
"""

import math

# RFC 6298: how fast mean and mean deviation follow the delays, and how many deviations are added.
MEAN_GAIN, DEVIATION_GAIN, DEVIATIONS = 1 / 8, 1 / 4, 4.0
LATE_STEP = 0.05  # by which one late chunk makes the number of deviations larger
DEVIATIONS_MIN = 1.0  # however rarely chunks are late


class Arrival:
    """Forecasts the delay that a share of 1 - `miss_rate` of the chunks stays below.

    The forecast is the mean plus a number of mean deviations (RFC 6298). This number is learned: each late
    chunk raises it, and each chunk in time lowers it. So in the long run, `miss_rate` of the chunks are late
    (Gibbs and Candès, Adaptive Conformal Inference Under Distribution Shift, 2021).
    """

    def __init__(self, miss_rate: float) -> None:
        self.mean_s: float | None = None
        self._deviation_s = 0.0
        self._deviations = DEVIATIONS
        self._miss_rate = miss_rate

    @property
    def late_s(self) -> float | None:
        """After this delay a chunk is late; None before the first one."""
        return None if self.mean_s is None else self.mean_s + self._deviations * self._deviation_s

    @property
    def usual_s(self) -> float | None:
        """The delay that few chunks exceed, as in RFC 6298: unlike `late_s`, lost chunks do not change it."""
        return None if self.mean_s is None else self.mean_s + DEVIATIONS * self._deviation_s

    def learn(self, seconds: float) -> None:
        """A chunk took this long."""
        mean_s, late_s = self.mean_s, self.late_s
        if mean_s is None or late_s is None:
            self.mean_s, self._deviation_s = seconds, 0.5 * seconds
            return
        self._adapt(1.0 if seconds > late_s else 0.0)
        self._deviation_s += DEVIATION_GAIN * (abs(seconds - mean_s) - self._deviation_s)
        self.mean_s = mean_s + MEAN_GAIN * (seconds - mean_s)

    def miss(self) -> None:
        """A chunk was given up."""
        self._adapt(1.0)

    def _adapt(self, late: float) -> None:
        change = math.exp(LATE_STEP * (late - self._miss_rate))
        self._deviations = max(DEVIATIONS_MIN, self._deviations * change)
