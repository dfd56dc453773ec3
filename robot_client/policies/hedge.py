"""The wrapper `hedge`: plans a second run for a task that is late.

When a task counts as late is in `Outlook.overdue_s`; `execution/race.py` starts the second run.
"""

from offboard.robot_client.policies.decision import Decision, Hedge, Policy
from offboard.robot_client.policies.forecast import Forecast, cheapest


class WithHedges:
    """Adds a hedge: the second site starts when the first should still need longer than the second would.

    After Dean and Barroso, The Tail at Scale (2013). They wait for a quantile of all times; here the past
    errors of the first site say how much longer a late task should take. With variants, the quality that the
    second site would lose counts as time that it needs.
    """

    def __init__(self, inner: Policy) -> None:
        self._inner = inner

    def decide(self, forecast: Forecast) -> Decision:
        decision = self._inner.decide(forecast)
        if decision.both or decision.second or forecast.duplicates < 1:
            return decision
        chosen = forecast.sites[decision.site]
        others = {
            site: one.predicted_s + one.quality.lost_s - chosen.quality.lost_s
            for site, one in forecast.sites.items()
            if site != decision.site and one.predicted_s is not None and not one.condition.silent
        }
        if not others:
            return decision
        second = cheapest(others)
        after_s = chosen.overdue_s(others[second])
        if after_s is None or after_s <= 0:  # a line below 0 does not say when a task is late
            return decision
        hedge = Hedge(second, after_s)
        return Decision(decision.site, decision.why, decision.policy, second=hedge)
