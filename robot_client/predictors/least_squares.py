"""Least squares: over the window, as psi^l and psi^c of the paper, and with weights that decay.

Predictors that also resist outliers are in `adaptive` and `robust`.
"""

import math

from offboard.common.errors import ConfigError
from offboard.common.tasks import Size
from offboard.robot_client.predictors.base import SIZE_MIN, Prediction, check_observation
from offboard.robot_client.predictors.plane import Plane
from offboard.robot_client.predictors.window import Window, checked_length

ROUNDING = 2.0**-50  # 4 units in the last place: smaller relative differences of sizes are 0


class LeastSquares:
    """Ordinary least squares of seconds on size over the last `window` executions.

    m = sum((d - mean d)(t - mean t)) / sum((d - mean d)^2); c = mean t - m mean d; p = m d + c.
    If all sizes are equal, the slope is 0 and p = mean t. Sizes of several numbers get a plane.
    """

    def __init__(self, window: int, seed: int = 0) -> None:  # noqa: ARG002 - nothing is random
        self.window = Window(window)
        self._plane = Plane(window)  # empty, or the window is

    @property
    def full(self) -> bool:
        return self.window.full or self._plane.full

    def __len__(self) -> int:
        return len(self.window) + len(self._plane)

    def learn(self, size: Size, seconds: float) -> None:
        if isinstance(size, tuple):
            for number in size:
                check_observation(number, seconds)
            self._plane.learn(size, seconds)
            return
        check_observation(size, seconds)
        self.window.append(size, seconds)

    def predict(self, size: Size, ahead: int = 1) -> Prediction | None:  # noqa: ARG002
        if isinstance(size, tuple):
            return self._plane.predict(size)
        if not len(self.window):
            return None
        of = self.window.moments()
        slope = of.sdt / of.sdd if of.sdd > 0 else 0.0
        spread = math.sqrt(max(0.0, of.stt - slope * of.sdt) / (of.count - 2)) if of.count > 2 else None
        return Prediction(of.mean_seconds + slope * of.deviation(size), spread)


class RecursiveLeastSquares:
    """Least squares of seconds on size, where each execution weighs `forgetting` times as much as the next.

    There is neither a prior nor a window: each execution updates means and centred sums, in constant time
    and memory. If the sizes that still have weight are equal up to rounding, the slope is 0 and p is the
    weighted mean of seconds. Times that never change are predicted exactly.

    forgetting: from 0.5 to 1. None is 1 - 1 / window, so that the sum of all weights approaches the window.
        With 1 the line is that of ordinary least squares over all executions.
    """

    def __init__(self, window: int, seed: int = 0, forgetting: float | None = None) -> None:  # noqa: ARG002
        self.window = checked_length(window)
        self.forgetting = checked_forgetting(window, forgetting)
        self._count = 0  # stops at the window
        self._weight = self._squares = 0.0  # sums of the weights and of their squares
        self._size, self._seconds = _Mean(), _Mean()
        self._sdd = self._sdt = self._stt = 0.0

    @property
    def full(self) -> bool:
        return self._count == self.window

    def __len__(self) -> int:
        return self._count

    def learn(self, size: float, seconds: float) -> None:
        """West (1979): each sum grows by d t W_old / W_new; d and t are distances from the old means."""
        check_observation(size, seconds)
        fade = self.forgetting
        faded = fade * self._weight
        self._count = min(self._count + 1, self.window)
        self._weight, self._squares = faded + 1, fade * fade * self._squares + 1
        d, t = self._size.offset(size), self._seconds.offset(seconds)
        self._size.move(d / self._weight)
        self._seconds.move(t / self._weight)
        if (
            abs(d) <= ROUNDING * size
        ):  # otherwise, after many equal sizes, only rounding errors would be left in the sums
            d = 0.0
        share = faded / self._weight
        self._sdd = fade * self._sdd + share * d * d
        self._sdt = fade * self._sdt + share * d * t
        self._stt = fade * self._stt + share * t * t

    def predict(self, size: float, ahead: int = 1) -> Prediction | None:  # noqa: ARG002
        if not self._count:
            return None
        return Prediction(self._expected(size), self._spread(self._slope()))

    def _expected(self, size: float) -> float:
        return self._seconds.value + self._slope() * self._size.offset(size)

    def _slope(self) -> float:
        least = max(ROUNDING * self._size.value, SIZE_MIN)
        return self._sdt / self._sdd if self._sdd > self._weight * least * least else 0.0

    def _spread(self, slope: float) -> float | None:
        """Root of the weighted residual sum of squares over W - 2 sum(w^2) / W; N - 2 without decay."""
        if self._count < 3:
            return None
        freedom = self._weight - 2 * self._squares / self._weight
        return math.sqrt(max(0.0, self._stt - slope * self._sdt) / freedom)


def checked_forgetting(window: int, forgetting: float | None) -> float:
    """The factor by which a weight decays with each execution; ConfigError if it is out of range."""
    share = 1 - 1 / window if forgetting is None else forgetting
    if not 0.5 <= share <= 1:
        raise ConfigError(f"forgetting {forgetting}: must be from 0.5 to 1")
    return share


class _Mean:
    """A mean as the sum of two floats, so that it keeps changes far below its last digit."""

    __slots__ = ("_rest", "value")

    def __init__(self) -> None:
        self.value = self._rest = 0.0

    def offset(self, value: float) -> float:
        """Value minus mean."""
        return (value - self.value) - self._rest

    def move(self, by: float) -> None:
        rest = self._rest + by
        moved = self.value + rest
        self._rest = rest - (moved - self.value)  # the rounding error of `moved` (Dekker's fast two-sum)
        self.value = moved
