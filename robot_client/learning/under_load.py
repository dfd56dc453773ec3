"""How long a site takes while other programs load it, from how long it takes otherwise.

The times without load are predicted by `site`.
"""

from collections import deque
from statistics import median

KEPT = 20  # the last times under load
OUTLIER = 3.0  # times the median: a longer time counts as this long
PRIOR = 4.0  # times under load that the prior of the slope counts for, at the usual distance


class UnderLoad:
    """A line from the time expected without load to the time under load.

    Loads are rare and short, so the first time under load must be enough for a prediction. But a line through
    the first few times is unreliable for other sizes, so its slope has a prior. With `onboard`, everything
    takes longer by the same factor; a server takes its usual time plus a constant, because the robot is slow
    to send and receive. This is ridge regression with the penalty in units of the mean (Hoerl and Kennard,
    1970).
    """

    def __init__(self, *, onboard: bool) -> None:
        self._onboard = onboard
        self._kept: deque[tuple[float, float]] = deque(maxlen=KEPT)

    @property
    def known(self) -> bool:
        """Whether a time under load was learnt yet."""
        return bool(self._kept)

    def learn(self, expected_s: float, seconds: float) -> None:
        """A task took `seconds` under load, where `expected_s` was expected without the load."""
        self._kept.append((expected_s, seconds))

    def expect(self, expected_s: float) -> float:
        """The time under load, never below the time without it; only while `known`."""
        count = len(self._kept)
        most = OUTLIER * median([seconds for _, seconds in self._kept])
        x = sum([one for one, _ in self._kept]) / count
        y = sum([min(seconds, most) for _, seconds in self._kept]) / count
        prior = y / x if self._onboard and x > 0 else 1.0
        ridge = PRIOR * x * x
        sxx = sxy = 0.0
        for one, seconds in self._kept:
            sxx += (one - x) * (one - x)
            sxy += (one - x) * (min(seconds, most) - y)
        slope = (sxy + ridge * prior) / (sxx + ridge) if sxx + ridge > 0 else prior
        return max(expected_s, y + max(0.0, slope) * (expected_s - x))
