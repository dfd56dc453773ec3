"""How much work a task of some size is: learnt from the results of all sites, so that it is never stale.

What the unit of work is, a kind says itself (`@task(work=...)`); the times of a site are learnt per work.
"""

from bisect import bisect_left, insort
from collections import deque

PAIRS_MAX = 200  # (size, work) remembered
ODD = 3.0  # times the median of those near: more work than this counts as so much
ROUNDING = 1e-12  # of the squares of what sizes differ by: less is all of one size
NEAR = 20  # of them, those nearest in size: the line through them tells


class SharedWork:
    """Local linear regression of work on size (Cleveland 1979, with equal weights).

    Work need not grow evenly with size: a line through all of it is off where it matters, at the size where
    two sites take as long.
    """

    def __init__(self) -> None:
        self._order: deque[tuple[float, float]] = deque()
        self._sorted: list[tuple[float, float]] = []

    def learn(self, size: float, work: float) -> None:
        """A result said that a task of this size was so much work."""
        if len(self._order) == PAIRS_MAX:
            del self._sorted[bisect_left(self._sorted, self._order.popleft())]
        self._order.append((size, work))
        insort(self._sorted, (size, work))

    def predict(self, size: float) -> float | None:
        """The work to expect; None before anything is known."""
        count = len(self._sorted)
        if not count:
            return None
        first = max(0, min(bisect_left(self._sorted, (size,)) - NEAR // 2, count - NEAR))
        near = self._sorted[first : first + NEAR]
        most = ODD * sorted([work for _, work in near])[len(near) // 2]
        sx = sxx = sw = sxw = 0.0
        for one, work in near:
            x = one - size
            if work > most:
                work = most
            sx += x
            sxx += x * x
            sw += work
            sxw += x * work
        spread = len(near) * sxx - sx * sx
        if spread <= ROUNDING * len(near) * sxx:
            return sw / len(near)
        return max(0.0, (sw * sxx - sx * sxw) / spread)  # the line at x = 0
