"""The wrapper `probe`: now and then runs a task on a second site too, to learn how that site does.

`execution/race.py` starts both runs and uses the first answer.
"""

from offboard.common.variants import group_of
from offboard.robot_client.policies.decision import Decision, Policy, Probe, pairs
from offboard.robot_client.policies.forecast import Forecast
from offboard.robot_client.sites.runner import ONBOARD

PROBE_EVERY = 20  # tasks that a site has not run


class WithProbes:
    """Adds a probe of the site that has gone longest without a task, once that is PROBE_EVERY tasks.

    Equal servers of a group take turns, so that together they are not probed more often than one server.
    A probe makes no caller wait: the first answer is used, and both times are learnt. A silent site is not
    probed, because its first answered heartbeat says more.

    Onboard is probed only once the tasks since then have also taken PROBE_EVERY times as long as it needs:
    its run slows the answers of the others down.
    """

    def __init__(self, inner: Policy) -> None:
        self._inner = inner
        self.pairs = pairs(inner)

    def decide(self, forecast: Forecast) -> Decision:
        decision = self._inner.decide(forecast)
        if decision.both or decision.second or forecast.duplicates < 2:  # one is left for a hedge
            return decision
        turns = 1 + len(forecast.sites) - len({group_of(site) for site in forecast.sites})
        chosen, due = forecast.sites[decision.site], turns * PROBE_EVERY
        stalest, age = None, due - 1
        for site, one in forecast.sites.items():
            if one.age <= age or site == decision.site or one.in_flight or one.condition.silent:
                continue
            if site != ONBOARD or one.age * (chosen.predicted_s or 0.0) >= due * (one.predicted_s or 0.0):
                stalest, age = site, one.age
        if stalest is None:
            return decision
        return decision._replace(second=Probe(stalest), why=f"{decision.reason}; {stalest} is probed")
