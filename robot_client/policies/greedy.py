"""The rule `greedy`: the site with the lowest cost.

The costs come from `objectives`; `reason` says in words why a site was chosen.
"""

from collections.abc import Mapping
from functools import partial

from offboard.common.variants import group_of
from offboard.robot_client.policies.decision import Decision
from offboard.robot_client.policies.forecast import Forecast, Outlook, cheapest, costs_of, home
from offboard.robot_client.policies.reason import explain
from offboard.robot_client.predictors.base import WARM_UP
from offboard.robot_client.sites.runner import ONBOARD


class Greedy:
    """Runs each task on the site with the lowest cost, after a short warm-up.

    A site is known after WARM_UP runs of its own. While a run of an unknown site is under way, tasks go where
    something is known.
    """

    def decide(self, forecast: Forecast) -> Decision:
        for outlook in forecast.sites.values():
            if outlook.observations < WARM_UP and (warming := self._warm_up(forecast)) is not None:
                return warming
        known = [site for site, one in forecast.sites.items() if one.predicted_s is not None]
        site = cheapest(costs_of(forecast.only(known) if 0 < len(known) < len(forecast.sites) else forecast))
        return Decision(site, partial(explain, forecast, site), "greedy")

    def _warm_up(self, forecast: Forecast) -> Decision | None:
        """Let a site that is not known yet run the task too; the first good answer is used.

        The task runs onboard and on one server: runs that share a link teach wrong times.
        None if there is no such site, or if tasks under way will soon tell enough.
        """
        heard = {
            site: one for site, one in forecast.sites.items() if not (one.condition.silent or one.given_up)
        }
        learner = _learner(heard)
        if learner is None or len(heard) == 1:
            return None
        sites, onboard = [learner], heard.get(ONBOARD)
        known = [site for site, one in heard.items() if site != learner and one.predicted_s is not None]
        if learner == ONBOARD:
            sites += [cheapest(costs_of(forecast.only(known)))] if known else []
        elif onboard is not None and not onboard.in_flight:
            sites.append(ONBOARD)
        elif known:
            return None  # until onboard is free, which answers if this server does not
        cold = sorted(site for site in sites if _is_cold(heard[site]))
        return Decision(
            home(forecast.only(sites)),
            f"warm-up: too little is known of {' and '.join(cold)}",
            "greedy",
            both=len(sites) > 1,
            spared=tuple(site for site in forecast.sites if site not in sites),
        )


def _learner(heard: Mapping[str, Outlook]) -> str | None:
    """The site that should run the task to become known, if any.

    While a run of a site that is not known is under way, the site gets no other one, nor does another server
    that is not known. Equal servers learn from one of them.
    """
    cold = {site: one for site, one in heard.items() if _is_cold(one)}
    busy = any(one.under_way for site, one in cold.items() if site != ONBOARD)
    free = {site: one for site, one in cold.items() if not (one.under_way or (busy and site != ONBOARD))}
    by_runs = sorted(free, key=lambda site: free[site].observations)
    best = {group_of(site): site for site in by_runs}.values()
    return min(best, key=lambda site: (free[site].observations, site == ONBOARD), default=None)


def _is_cold(one: Outlook) -> bool:
    """Too little is known of the site. One whose runs fail is not tried for that any more."""
    return one.observations < WARM_UP > one.failures and not one.full
