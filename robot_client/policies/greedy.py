"""The rule `greedy`: the site with the lowest cost, and the reason in words.

The costs come from `objectives`.
"""

from functools import partial

from offboard.common.tasks import show_size
from offboard.common.text.wording import duration, with_interval
from offboard.common.variants import group_of
from offboard.robot_client.policies.decision import Decision
from offboard.robot_client.policies.forecast import WHOLE, Forecast, Outlook, cheapest, costs_of, home
from offboard.robot_client.predictors.base import WARM_UP
from offboard.robot_client.sites.runner import ONBOARD, Condition


class Greedy:
    """Runs each task on the site with the lowest cost, after a short warm-up on all sites."""

    def decide(self, forecast: Forecast) -> Decision:
        for outlook in forecast.sites.values():
            if outlook.observations < WARM_UP and (warming := self._warm_up(forecast)) is not None:
                return warming
        site = cheapest(costs_of(forecast))
        return Decision(site, partial(explain, forecast, site), "greedy")

    def _warm_up(self, forecast: Forecast) -> Decision | None:
        """Run on all sites that can be expected to answer, unless tasks under way will soon tell enough."""
        heard = {
            site: one for site, one in forecast.sites.items() if not (one.condition.silent or one.given_up)
        }
        cold = [site for site, one in heard.items() if _is_cold(one)]
        if not cold or len(heard) == 1:
            return None
        taught = {group_of(site): site for site in cold}.values()  # equal servers learn from one of them
        reason = f"warm-up: too little is known of {' and '.join(sorted(taught))}"
        hearing = [site for site in heard if site in taught or site not in cold]
        spared = [site for site in forecast.sites if site not in hearing]
        return Decision(home(forecast.only(heard)), reason, "greedy", both=True, spared=tuple(spared))


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
    """A task that is under way will soon add an observation: it is waited for. A site that fails is not."""
    return one.observations < WARM_UP > one.failures and not (one.full or one.in_flight)


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
