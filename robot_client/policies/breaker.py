"""The wrapper `breaker`: a circuit breaker for sites that keep failing.

Failures are counted by `learning`; how often a site is tried again while it is left out is decided here.
"""

from offboard.robot_client.policies.decision import Decision, Policy, decide_among
from offboard.robot_client.policies.forecast import Forecast
from offboard.robot_client.sites.runner import ONBOARD

BREAK_AFTER = 3  # failures in a row
BROKEN_FOR = 10  # tasks, after the first break
BROKEN_MAX = 160  # tasks, at most


class WithBreaker:
    """Leaves out a site that failed BREAK_AFTER times in a row, for a number of tasks.

    The number starts at BROKEN_FOR and doubles with each further failure (Nygard, Release It!).
    Onboard is never left out.
    """

    def __init__(self, inner: Policy) -> None:
        self._inner = inner

    def decide(self, forecast: Forecast) -> Decision:
        left = [
            site
            for site, one in forecast.sites.items()
            if site == ONBOARD or not _broken(one.failures, one.age)
        ]
        return decide_among(left or forecast.sites.keys(), forecast, self._inner)


def _broken(failures: int, age: int) -> bool:
    if failures < BREAK_AFTER:
        return False
    doublings = min(failures - BREAK_AFTER, BROKEN_MAX.bit_length())
    return age < min(BROKEN_MAX, BROKEN_FOR << doublings)
