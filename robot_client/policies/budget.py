"""The wrapper `budget`: keeps tasks within the caps on bytes and joules per minute.

`allowance` counts what the caps leave.
"""

import math
from collections.abc import Collection

from offboard.robot_client.policies.decision import Decision, Policy, decide_among, pairs
from offboard.robot_client.policies.forecast import Forecast
from offboard.robot_client.sites.runner import ONBOARD


class WithBudget:
    """Leaves out the sites that would take more bytes or joules than the caps leave.

    If no site fits, the task runs onboard: it must be answered.
    """

    def __init__(self, inner: Policy) -> None:
        self._inner = inner
        self.pairs = pairs(inner)

    def decide(self, forecast: Forecast) -> Decision:
        fit = [site for site in forecast.sites if _fits(forecast, {site})] or [ONBOARD]
        decision = decide_among(fit, forecast, self._inner)
        if decision.both and not _fits(forecast, forecast.sites.keys() - decision.spared):
            why = f"{decision.reason}; the caps allow one site only"
            return decision._replace(both=False, spared=(), why=why)
        if decision.second is not None and not _fits(forecast, {decision.site, decision.second.site}):
            decision = decision._replace(second=None)
        if decision.latest is not None and not _fits(forecast, {decision.site, decision.latest.site}):
            decision = decision._replace(latest=None)
        return decision


def _fits(forecast: Forecast, sites: Collection[str]) -> bool:
    """Whether the caps leave enough for a run on each of these sites."""
    taken = [forecast.sites[site] for site in sites]
    return (
        math.fsum(one.bytes for one in taken) <= forecast.bytes_left
        and math.fsum(one.joules for one in taken) <= forecast.joules_left
    )
