"""The FIFO window of one site: its last N executions, and the centred sums that a fitted line needs.

Fitting and predicting are left to the predictors.
"""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

from offboard.common.errors import ConfigError

WINDOW = 50  # the default of N
WINDOW_MAX = 1_000_000  # observations, so that a typing error does not fill the memory
CANCELLATION_MAX = 1e-3  # sums are recomputed if less than this share of their largest value is left


@dataclass(slots=True)
class Moments:
    """Means and centred sums over a window, for size d and seconds t.

    sdd = sum((d - mean d)^2), sdt = sum((d - mean d)(t - mean t)), stt = sum((t - mean t)^2).
    The mean size is `origin + mean_offset`. The two stay apart, as their sum would round away small
    differences between sizes.
    """

    count: int
    origin: float
    mean_offset: float
    mean_seconds: float
    sdd: float
    sdt: float
    stt: float

    def deviation(self, size: float) -> float:
        """Size minus mean size."""
        return (size - self.origin) - self.mean_offset


class Window:
    """The last `length` observations (size, seconds), oldest first: queue B of Algorithm 1.

    Appending, and reading the moments, takes constant time on average. The sums are updated with each
    observation, relative to a point near the mean. They are recomputed from the window after every `length`
    appends, and whenever cancellation has cost too many of their digits.
    """

    def __init__(self, length: int) -> None:
        self.length = checked_length(length)
        self._observations: deque[tuple[float, float]] = deque(maxlen=length)
        self._origin_d = self._origin_t = 0.0
        self._sx = self._sy = self._sxx = self._sxy = self._syy = 0.0
        self._peak_xx = self._peak_yy = 0.0
        self._appends = 0

    def __len__(self) -> int:
        return len(self._observations)

    def __iter__(self) -> Iterator[tuple[float, float]]:
        return iter(self._observations)

    @property
    def full(self) -> bool:
        return len(self._observations) == self.length

    def append(self, size: float, seconds: float) -> None:
        """Add the newest observation. A full window drops the oldest one."""
        x, y = size - self._origin_d, seconds - self._origin_t
        sx, sy = self._sx + x, self._sy + y
        sxx, sxy, syy = self._sxx + x * x, self._sxy + x * y, self._syy + y * y
        if self.full:
            old_size, old_seconds = self._observations[0]
            x, y = old_size - self._origin_d, old_seconds - self._origin_t
            sx, sy = sx - x, sy - y
            sxx, sxy, syy = sxx - x * x, sxy - x * y, syy - y * y
        self._observations.append((size, seconds))
        self._sx, self._sy, self._sxx, self._sxy, self._syy = sx, sy, sxx, sxy, syy
        self._peak_xx, self._peak_yy = max(self._peak_xx, sxx), max(self._peak_yy, syy)
        self._appends += 1
        if self._appends >= self.length:
            self._recentre()

    def moments(self) -> Moments:
        """The moments; the window must hold at least one observation."""
        found = self._sums_to_moments()
        if found.sdd < CANCELLATION_MAX * self._peak_xx or found.stt < CANCELLATION_MAX * self._peak_yy:
            self._recentre()
            found = self._sums_to_moments()
        return found

    def _sums_to_moments(self) -> Moments:
        count = len(self._observations)
        mean_x, mean_y = self._sx / count, self._sy / count
        return Moments(
            count=count,
            origin=self._origin_d,
            mean_offset=mean_x,
            mean_seconds=self._origin_t + mean_y,
            sdd=self._sxx - self._sx * mean_x,
            sdt=self._sxy - self._sx * mean_y,
            stt=self._syy - self._sy * mean_y,
        )

    def _recentre(self) -> None:
        """Recompute the sums around the mean. They are exactly zero if all values are equal."""
        self._origin_d = _centre([size for size, _ in self._observations])
        self._origin_t = _centre([seconds for _, seconds in self._observations])
        xs = [size - self._origin_d for size, _ in self._observations]
        ys = [seconds - self._origin_t for _, seconds in self._observations]
        self._sx, self._sy = sum(xs), sum(ys)
        self._sxx = sum(x * x for x in xs)
        self._sxy = sum(x * y for x, y in zip(xs, ys, strict=True))
        self._syy = sum(y * y for y in ys)
        self._peak_xx, self._peak_yy = self._sxx, self._syy
        self._appends = 0


def checked_length(length: int) -> int:
    """The length itself; ConfigError if no window may have it."""
    if not 2 <= length <= WINDOW_MAX:
        raise ConfigError(f"window {length}: must be from 2 to {WINDOW_MAX}")
    return length


def _centre(values: list[float]) -> float:
    """The mean. If all values are equal it is that value, which a rounded mean may miss."""
    if not values or min(values) == max(values):
        return values[0] if values else 0.0
    return sum(values) / len(values)
