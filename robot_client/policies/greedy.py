"""The rule `greedy`: the site with the lowest cost, and the reason in words.

The costs come from `objectives`.
"""

from collections.abc import Mapping
from functools import partial

from offboard.common.tasks import show_size
from offboard.common.text.wording import duration, with_interval
from offboard.common.variants import group_of
from offboard.robot_client.policies.decision import Decision
from offboard.robot_client.policies.forecast import WHOLE, Forecast, Outlook, cheapest, costs_of, home
from offboard.robot_client.predictors.base import WARM_UP
from offboard.robot_client.sites.runner import ONBOARD, Condition


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


def explain(forecast: Forecast, site: str) -> str:
    """The reason to choose this site: predictions, what was measured, how old the other sites are."""
    sites = forecast.sites
    parts, stale = [f"{site}: {_times(sites[site])}"], ""
    measured = f"size {show_size(forecast.size, '.3g')}"
    for name, one in sites.items():
        if name != site:
            parts.append(f"{name} {_times(one)}")
            if one.age:
                stale += f"; {name} last tried {one.age} tasks ago"
        measured += _measured(name, one.condition, "" if len(sites) == 2 else f" {name}")
    return f"{' against '.join(parts)}; {measured}{stale}"


def _is_cold(one: Outlook) -> bool:
    """Too little is known of the site. One whose runs fail is not tried for that any more."""
    return one.observations < WARM_UP > one.failures and not one.full


def _times(one: Outlook) -> str:
    """The prediction, and the quality of the site's variant with its worth in time."""
    said, quality = _predicted(one), one.quality
    if quality is WHOLE:
        return said
    if quality.lost_s:
        return f"{said} + {duration(quality.lost_s)} for quality {quality.value:g}"
    return f"{said}, quality {quality.value:g}"


def _predicted(one: Outlook) -> str:
    if one.condition.silent:
        return "silent"
    if one.predicted_s is None:
        return "unknown"
    if one.low_s is None or one.high_s is None:
        return duration(one.predicted_s)
    return with_interval(one.predicted_s, one.low_s, one.high_s)


def _measured(site: str, condition: Condition, of: str) -> str:
    said, there = "", of if of or site == ONBOARD else " there"
    if condition.round_trip_s is not None:
        said = f", queue{of} {condition.queue}, rtt{of} {duration(condition.round_trip_s)}"
    if site == ONBOARD and condition.load >= 0.005:
        said += f", load{of} {condition.load:.0%}"
    if condition.server_load >= 0.005:
        said += f", load{there} {condition.server_load:.0%}"
    if condition.capacity < 1.0:
        said += f", capacity{there} {condition.capacity:.0%}"
    if condition.wait_s:
        said += f", wait{of} {duration(condition.wait_s)}"
    return said
