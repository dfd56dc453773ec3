"""How much work a task of some size is: learnt from the results of all sites, so that it is never stale.

What the unit of work is, a kind says itself (`@task(work=...)`); the times of a site are learnt per work.
"""

from array import array
from bisect import bisect_left, bisect_right
from collections import deque

PAIRS_MAX = 200  # (size, work) remembered
ODD = 3.0  # times the median of those near: more work than this counts as so much
ROUNDING = 1e-12  # of the squares of what sizes differ by: less is all of one size
NEAR = 20  # of them, those nearest in size: the line through them tells


class SharedWork:
    """Local linear regression of work on size (Cleveland 1979, with equal weights).

    Work need not grow evenly with size: a line through all of it is off where it matters, at the size where
    two sites take as long.

    Sizes and work are in arrays, not pairs of objects: the planner leaves nothing of those in a CPU's caches.
    """

    def __init__(self) -> None:
        self._order: deque[tuple[float, float]] = deque()
        self._sizes, self._works = array("d"), array("d")  # in order of both

    def learn(self, size: float, work: float) -> None:
        """A result said that a task of this size was so much work."""
        if len(self._order) == PAIRS_MAX:
            at = self._place(*self._order.popleft())
            del self._sizes[at], self._works[at]
        self._order.append((size, work))
        at = self._place(size, work)
        self._sizes.insert(at, size)
        self._works.insert(at, work)

    def predict(self, size: float) -> float | None:
        """The work to expect; None before anything is known."""
        count = len(self._sizes)
        if not count:
            return None
        first = max(0, min(bisect_left(self._sizes, size) - NEAR // 2, count - NEAR))
        sizes, works = self._sizes[first : first + NEAR], self._works[first : first + NEAR]
        count = len(sizes)
        most = ODD * sorted(works)[count // 2]
        sx = sxx = sw = sxw = 0.0
        for one, work in zip(sizes, works, strict=True):
            x = one - size
            if work > most:
                work = most
            sx += x
            sxx += x * x
            sw += work
            sxw += x * work
        spread = count * sxx - sx * sx
        if spread <= ROUNDING * count * sxx:
            return sw / count
        return max(0.0, (sw * sxx - sx * sxw) / spread)  # the line at x = 0

    def _place(self, size: float, work: float) -> int:
        """Of the first pair that is not before this one."""
        first = bisect_left(self._sizes, size)
        return bisect_left(self._works, work, first, bisect_right(self._sizes, size, first))
