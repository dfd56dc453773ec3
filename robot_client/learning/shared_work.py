"""How much work a task of a given size is, learnt from the results of all sites, so that it is never stale.

A kind defines its unit of work itself (`@task(work=...)`); the seconds per work are learnt for each site in
`site`.
"""

from array import array
from bisect import bisect_left, bisect_right
from collections import deque

from offboard.robot_client.predictors.base import REMEMBERED, ROUNDING

OUTLIER = 3.0  # times the median work nearby: more work than this counts as this much
NEIGHBOURS = 20  # pairs that are nearest in size, the newest of equal ones: the line goes through these


class SharedWork:
    """Local linear regression of work on size (Cleveland 1979, with equal weights).

    Work need not be proportional to size. One line through all pairs would be wrong at the most important
    size: the one where two sites take equally long.

    Sizes and work are in arrays, because a planner evicts lists of objects from the caches of a CPU.
    """

    def __init__(self) -> None:
        self._order: deque[float] = deque()  # the sizes as they came
        self._sizes, self._works = array("d"), array("d")  # sorted by size; those of one size as they came

    def learn(self, size: float, work: float) -> None:
        """A result said that a task of this size was this much work."""
        if len(self._order) == REMEMBERED:
            at = bisect_left(self._sizes, self._order.popleft())
            del self._sizes[at], self._works[at]
        self._order.append(size)
        at = bisect_right(self._sizes, size)
        self._sizes.insert(at, size)
        self._works.insert(at, work)

    def predict(self, size: float) -> float | None:
        """The expected work; None before anything is known."""
        count = len(self._sizes)
        if not count:
            return None
        below, end = bisect_left(self._sizes, size), bisect_right(self._sizes, size)
        first = max((below + end - NEIGHBOURS) // 2, end - NEIGHBOURS)
        first = max(0, min(first, count - NEIGHBOURS))
        sizes, works = self._sizes[first : first + NEIGHBOURS], self._works[first : first + NEIGHBOURS]
        count = len(sizes)
        most = OUTLIER * sorted(works)[count // 2]
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
