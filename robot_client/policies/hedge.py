"""The wrapper `hedge`: plans a second run for a task that is late, or whose deadline comes near.

When a task is late is in `Outlook.overdue_s`; when onboard must start for a deadline is in `objectives`.
`execution/race.py` starts the second run.
"""

from collections.abc import Mapping

from offboard.robot_client.policies.decision import Decision, Hedge, Policy
from offboard.robot_client.policies.forecast import Forecast, Outlook, cheapest
from offboard.robot_client.sites.runner import ONBOARD


class WithHedges:
    """Adds a hedge: the second site starts when the first should still need longer than the second would.

    After Dean and Barroso, The Tail at Scale (2013). They wait for a quantile of all times; here the past
    errors of the first site say how much longer a late task should take. With variants, the quality that the
    second site would lose counts as time that it needs.

    A call with a deadline that was sent to another site starts onboard too, at the latest when onboard should
    still make it. That run is no matter of the allowance, just as a fallback.
    """

    pairs = True

    def __init__(self, inner: Policy) -> None:
        self._inner = inner

    def decide(self, forecast: Forecast) -> Decision:
        decision = self._inner.decide(forecast)
        if forecast.latest_s is not None and ONBOARD not in _first(decision, forecast.sites):
            decision = decision._replace(latest=Hedge(ONBOARD, forecast.latest_s))
        if decision.both or decision.second or forecast.duplicates < 1:
            return decision
        chosen = forecast.sites[decision.site]
        others = {
            site: one.predicted_s + one.quality.lost_s - chosen.quality.lost_s
            for site, one in forecast.sites.items()
            if site != decision.site and one.predicted_s is not None and not one.condition.silent
        }
        if forecast.deadline_s is not None:  # until then, a better answer is waited for
            others = {site: s for site, s in others.items() if not _is_worse(forecast.sites[site], chosen)}
        if not others:
            return decision
        second = cheapest(others)
        after_s = chosen.overdue_s(others[second])
        if after_s is None or after_s <= 0:  # a line below 0 does not say when a task is late
            return decision
        if forecast.deadline_s is not None and after_s >= forecast.deadline_s:
            return decision
        hedge = Hedge(second, after_s)
        return Decision(decision.site, decision.why, decision.policy, second=hedge, latest=decision.latest)


def _first(decision: Decision, sites: Mapping[str, Outlook]) -> set[str]:
    """The sites that start at once."""
    return sites.keys() - decision.spared if decision.both else {decision.site}


def _is_worse(one: Outlook, than: Outlook) -> bool:
    return one.quality.value < than.quality.value
