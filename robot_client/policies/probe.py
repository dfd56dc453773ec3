"""The wrapper `probe`: now and then runs a task on a second site too, to learn how that site does.

`execution/race.py` starts both runs and uses the first answer.
"""

from offboard.common.variants import group_of
from offboard.robot_client.policies.decision import Decision, Policy, Probe, pairs
from offboard.robot_client.policies.forecast import Forecast

PROBE_EVERY = 20  # tasks that a site has not run


class WithProbes:
    """Adds a probe of the site that has gone longest without a task, once that is PROBE_EVERY tasks.

    Equal servers of a group take turns, so that together they are not probed more often than one server.
    A probe makes no caller wait: the first answer is used, and both times are learnt. A silent site is not
    probed, because its first answered heartbeat says more.
    """

    def __init__(self, inner: Policy) -> None:
        self._inner = inner
        self.pairs = pairs(inner)

    def decide(self, forecast: Forecast) -> Decision:
        decision = self._inner.decide(forecast)
        if decision.both or decision.second or forecast.duplicates < 2:  # one is left for a hedge
            return decision
        turns = 1 + len(forecast.sites) - len({group_of(site) for site in forecast.sites})
        stalest, age = None, turns * PROBE_EVERY - 1
        for site, one in forecast.sites.items():
            if one.age > age and site != decision.site and not (one.in_flight or one.condition.silent):
                stalest, age = site, one.age
        if stalest is None:
            return decision
        return decision._replace(second=Probe(stalest), why=f"{decision.reason}; {stalest} is probed")
