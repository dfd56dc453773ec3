"""What a site takes while other programs load the robot, told by what it takes otherwise."""

from collections import deque
from statistics import median

KEPT = 20  # of the last times under load
ODD = 3.0  # times their median: a longer time counts as so much
PRIOR = 4.0  # times under load: so much does what is believed of a slope weigh, at the usual distance


class UnderLoad:
    """A line over the times that were expected without the load.

    Loads come seldom and are short: the first time under one tells. The first ones are of whatever sizes come
    by, and a line through them alone is not to be believed far from them. So its slope has a prior. What runs
    onboard takes so many times as long (`onboard`); a server as long, but the robot is slow to send and to
    hear. It is ridge regression, with its penalty in units of the mean (Hoerl and Kennard, 1970).
    """

    def __init__(self, *, onboard: bool) -> None:
        self._onboard = onboard
        self._kept: deque[tuple[float, float]] = deque(maxlen=KEPT)

    @property
    def known(self) -> bool:
        return bool(self._kept)

    def learn(self, expected_s: float, seconds: float) -> None:
        """It took so long where without the load `expected_s` was expected."""
        self._kept.append((expected_s, seconds))

    def expect(self, expected_s: float) -> float:
        """Never less than without the load. Of at least one that was learnt."""
        count = len(self._kept)
        most = ODD * median([seconds for _, seconds in self._kept])
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
