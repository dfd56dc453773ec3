"""The wrapper `probe`: now and then runs a task on a second site too, to learn how that site does.

`execution/race.py` starts both runs and uses the first answer.
"""

from offboard.robot_client.policies.decision import Decision, Policy, Probe
from offboard.robot_client.policies.forecast import Forecast, Outlook
from offboard.robot_client.sites.runner import ONBOARD

PROBE_EVERY = 20  # tasks that a site has not run
ONBOARD_PROBE_FACTOR = 2.0  # probe onboard half as often: its load and its capacity are measured directly
PROBE_FACTOR_MAX = 8.0
STALE = round(PROBE_EVERY * PROBE_FACTOR_MAX)  # tasks after which every site is probed
RESERVED = 1  # second runs that are left for hedges


class WithProbes:
    """Adds a probe of the site that has gone longest without a task, once that is PROBE_EVERY tasks.

    A probe makes no caller wait: the first answer is used, and both times are learnt. A silent site is not
    probed, because its first answered heartbeat says more.

    A run onboard takes CPU time from the other tasks of the robot. Therefore the number of tasks between two
    probes of onboard grows with the square of (onboard prediction / prediction of the chosen site): a slow
    run takes longer, and is less likely to show that onboard is better. But a task that is much smaller than
    all that onboard has run is probed there at once: it ends soon, and its time cannot be predicted yet.
    """

    def __init__(self, inner: Policy) -> None:
        self._inner = inner

    def decide(self, forecast: Forecast) -> Decision:
        decision = self._inner.decide(forecast)
        if decision.both or decision.second or forecast.duplicates < 1 + RESERVED:
            return decision
        stalest, age = "", 0
        for site, one in forecast.sites.items():
            if (
                one.age > age
                and (one.age >= PROBE_EVERY or one.smallest)
                and site != decision.site
                and one.age >= _probe_after(site, one, forecast.sites[decision.site])
                and not one.in_flight
                and not one.condition.silent
            ):
                stalest, age = site, one.age
        if not stalest:
            return decision
        return decision._replace(second=Probe(stalest), why=f"{decision.reason}; {stalest} is probed")


def _probe_after(site: str, one: Outlook, chosen: Outlook) -> float:
    """The number of tasks after which a site that has not run one is probed."""
    if site == ONBOARD and one.smallest:
        return 0.0
    if site != ONBOARD or not one.predicted_s or not chosen.predicted_s:
        return PROBE_EVERY
    slower = max(1.0, one.predicted_s / chosen.predicted_s)
    return PROBE_EVERY * min(ONBOARD_PROBE_FACTOR * slower**2, PROBE_FACTOR_MAX)
