"""A robust line through the times of one part of a task, which follows a site that changes.

It is a Kalman filter of an intercept and a slope, with three rules for times that a normal distribution does
not have: an outlier counts only up to a limit, two outliers on the same side are a change, and what outliers
take beyond the limit is predicted as a mean. What the line describes is up to `parts`.
"""

import math

NOISE = 0.2  # standard deviation of the first times, as a share of the usual time
PACE = 0.01  # by which a site becomes slower or faster from one task to the next
ODD = 3.0  # standard deviations: a time farther from the line is an outlier
RATE = 0.05  # of the running means, once there are enough times
TAIL_MAX = 2.0  # usual times: a longer outlier counts as this much in the mean of the outliers


class Line:
    """`a + b x` seconds on top of `apart_s` seconds, for an amount `x` whose usual value is near 1.

    With `together`, `a` and `b` change by the same factor, because a site that slows down is slower for all
    amounts. Otherwise they change independently, each in proportion to itself: the delay of a link and its
    bandwidth have nothing to do with each other.
    """

    __slots__ = (
        "_noise", "_paa", "_pab", "_pbb", "_side", "_tail", "_together", "_usual", "a", "b", "count",
    )  # fmt: skip

    def __init__(self, *, together: bool) -> None:
        self._together = together
        self.count = 0
        self.a = self.b = 0.0
        self._noise = NOISE * NOISE  # variance in units of the squared usual time
        self._paa = self._pab = self._pbb = 0.0  # the covariance of a and b
        self._usual = self._tail = 0.0
        self._side = 0.0  # of the line on which the last time was an outlier; 0: it was none

    @property
    def tail(self) -> float:
        """What outliers add to a time in the mean, as a share of it."""
        return self._tail

    @property
    def deviation(self) -> float:
        """The standard deviation of the times, as a share of them."""
        return math.sqrt(self._noise)

    @property
    def steepest(self) -> float:
        """The slope plus its standard deviation."""
        return self.b + math.sqrt(max(0.0, self._pbb))

    def at(self, x: float) -> float:
        """The seconds for this amount."""
        seconds = self.a + self.b * x
        return seconds if seconds > 0 else 0.0

    def error(self, x: float) -> float:
        """The standard error of the seconds for this amount; it grows with the distance from past amounts."""
        variance = self._paa + 2.0 * x * self._pab + x * x * self._pbb
        return math.sqrt(variance) if variance > 0.0 else 0.0

    def learn(self, x: float, y: float, apart_s: float = 0.0) -> None:
        """An amount `x` took `y` seconds beyond `apart_s`."""
        self.count += 1
        if self.count == 1:
            self._begin(x, y, apart_s)
            return
        rate = max(RATE, 1.0 / self.count)
        error, usual = y - self.a - self.b * x, self._usual
        unit = 0.5 * (max(0.0, self.a + self.b * x + apart_s) + usual) or 1.0
        self._usual += rate * (min(y + apart_s, ODD * usual) - usual)
        self._loosen(PACE * PACE, apart_s)
        variance, reach = self._reach(x, unit)
        side = math.copysign(1.0, error) if abs(error) > reach else 0.0
        changed = side < 0 or (side != 0 and side == self._side)
        if changed:
            error = min(
                error, unit
            )  # a change about doubles the time at most, until the next one confirms it
            self._loosen(min(1.0, (error / unit) ** 2), apart_s)
            variance, reach = self._reach(x, unit)
        self._side = side
        beyond = min(max(0.0, error - reach) / unit, TAIL_MAX)
        self._tail += rate * (beyond - self._tail)
        if not changed:  # a change is no noise
            seen = max(0.0, min(error * error, 0.5 * reach * reach) - variance) / (unit * unit or 1.0)
            self._noise += rate * (min(1.0, seen) - self._noise)  # a wrong first guess is no noise either
        self._correct(x, max(-reach, min(reach, error)), unit)

    def begin_as(self, other: "Line", x: float, y: float) -> None:
        """Begin with the shape of another line, through the first time `y` of the amount `x`."""
        factor = y / other.at(x)
        self.count, self._usual, self.a, self.b = 1, y, factor * other.a, factor * other.b
        self._paa = self._noise * y * y + 0.25 * y * y
        self._pab, self._pbb = 0.0, (0.5 * self.b) ** 2

    def bound(self, x: float, y: float, apart_s: float) -> None:
        """The amount `x` takes at most `y` seconds beyond `apart_s`."""
        if not self.count:
            self.learn(x, y, apart_s)
        elif self.a + self.b * x > y:
            self.a = y - self.b * x
            self._paa = max(self._paa, self._noise * (self.a + apart_s) ** 2)

    def _begin(self, x: float, y: float, apart_s: float) -> None:
        """Half of the first time belongs to its amount. As much is uncertain, or what noise hides."""
        self._usual = unit = y + apart_s or 1.0
        self.b = half = 0.5 * y if x > 0 else 0.0
        self.a = max(0.0, y - self.b * x)
        square = max(half, NOISE * unit) ** 2 if x > 0 else 0.0
        self._paa, self._pab, self._pbb = square * x * x + self._noise * unit * unit, -square * x, square

    def _loosen(self, share: float, apart_s: float) -> None:
        """Intercept and slope may have changed by the root of this share."""
        if self._together:
            self._paa += share * self.a * self.a
            self._pab += share * self.a * self.b
            self._pbb += share * self.b * self.b
        else:
            self._paa += share * (max(0.0, self.a) + apart_s) ** 2
            self._pbb += share * self.b * self.b

    def _reach(self, x: float, unit: float) -> tuple[float, float]:
        """The variance of the line at `x`, and the distance from which a time is an outlier."""
        variance = self._paa + 2.0 * x * self._pab + x * x * self._pbb
        return variance, ODD * math.sqrt(max(0.0, variance) + self._noise * unit * unit)

    def _correct(self, x: float, error: float, unit: float) -> None:
        pa, pb = self._paa + x * self._pab, self._pab + x * self._pbb
        whole = pa + x * pb + self._noise * unit * unit
        if not whole > 0.0:  # all times were equal
            return
        ka, kb = pa / whole, pb / whole
        self.a += ka * error
        self.b += kb * error
        self._paa -= ka * pa
        self._pab -= ka * pb
        self._pbb -= kb * pb
        if self.a < 0.0 and not self._together and self._paa > 0.0:
            # No delay is negative, so the slope was too steep: take the likeliest one for a delay of 0.
            self.b -= self.a * self._pab / self._paa
            self.a = 0.0


class RunningMean:
    """The plain mean of the first values, then a mean in which old values fade."""

    __slots__ = ("count", "value")

    def __init__(self) -> None:
        self.value = 0.0
        self.count = 0

    def add(self, one: float) -> None:
        self.count += 1
        rate = 1.0 / self.count
        self.value += (rate if rate > RATE else RATE) * (one - self.value)
