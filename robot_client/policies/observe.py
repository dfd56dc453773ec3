"""`Offloader.connect(observe=True)`: every task is answered onboard, and some are then measured elsewhere.

What this would have saved is estimated in `learning/savings.py`.
"""

from functools import partial

from offboard.robot_client.policies.decision import Decision, Policy, Probe
from offboard.robot_client.policies.forecast import Forecast
from offboard.robot_client.policies.probe import PROBE_EVERY
from offboard.robot_client.sites.runner import ONBOARD

NAME = "observe"


class Observe:
    """Asks a policy where each task should run, and runs it onboard all the same.

    Second runs go into probes. During the warm-up, and after PROBE_EVERY tasks without a run, they go to the
    site that has gone longest without one; otherwise to the site that the policy advises.
    """

    def __init__(self, inner: Policy) -> None:
        self._inner = inner

    def decide(self, forecast: Forecast) -> Decision:
        inner = self._inner.decide(forecast)
        advised = None if inner.both else inner.site
        probed = _probed(forecast, advised)
        second = None if probed is None else Probe(probed, answers=False)
        return Decision(ONBOARD, partial(_explain, inner), NAME, second=second, advised=advised)


def _probed(forecast: Forecast, advised: str | None) -> str | None:
    """The site to probe with this task, if any."""
    if forecast.duplicates < 1:
        return None
    ages = {
        site: one.age
        for site, one in forecast.sites.items()
        if not (site == ONBOARD or one.in_flight or one.condition.silent)
        and one.bytes <= forecast.bytes_left
        and one.joules <= forecast.joules_left
    }
    if not ages:
        return None
    stalest = max(ages, key=ages.__getitem__)
    if advised is None or ages[stalest] >= PROBE_EVERY:
        return stalest
    return advised if advised in ages else None


def _explain(inner: Decision) -> str:
    return f"only observed; the policy says {'all sites' if inner.both else inner.site}: {inner.reason}"
