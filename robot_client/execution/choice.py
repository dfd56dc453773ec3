"""The decision for one task, by the caller, who pins it to a site, or by the policy; and its plan.

What a policy compares is in `policies`; `race` carries the plan out.
"""

from collections.abc import Callable, Collection, Iterable, Mapping
from concurrent.futures import Future

from offboard.common.errors import ConfigError
from offboard.common.tasks import Kind
from offboard.common.variants import group_of
from offboard.robot_client.execution.race import Plan
from offboard.robot_client.policies import ALONE, BOTH, PINNED, Decision, Forecast, Policy, Probe
from offboard.robot_client.policies.forecast import cheapest, costs_of
from offboard.robot_client.sites.runner import ONBOARD


def sites_at(where: str, sites: Iterable[str]) -> list[str]:
    """The site of this name, or the sites of this group."""
    return [site for site in sites if where in (site, group_of(site))]


def check_where(where: str, kind: Kind, sites: Collection[str], *, changing: bool) -> None:
    """ConfigError unless a task of this kind may be pinned there; a site may come if the sites change."""
    if where != BOTH and not changing and not sites_at(where, sites):
        raise ConfigError(f"where={where!r} is not one of {', '.join([*sites, BOTH])}")
    if where == BOTH and not kind.duplicate:
        raise ConfigError(f"where='both': task {kind.name} is declared duplicate=False")


def pinned(where: str, forecast: Forecast) -> Decision:
    """The decision for a pinned call; it runs onboard if its site cannot take it."""
    if where == BOTH:
        both = len(forecast.sites) > 1
        why = "measured on both" if both else "only onboard was there"
        return Decision(ONBOARD, why, PINNED, both=both, waits=both)
    sites = sites_at(where, forecast.sites)
    if not sites:
        return Decision(ONBOARD, f"pinned to {where}, which cannot take it", PINNED)
    return Decision(cheapest(costs_of(forecast.only(sites))), "pinned by the caller", PINNED)


def decided(
    policy: Policy, forecast: Forecast, kind: Kind, *, absent: Mapping[str, str], known: Callable[[str], int]
) -> Decision:
    """The decision of the policy, without a second run if the kind must not run twice.

    `absent` says why sites are not in the forecast; `known` counts the observations of a site.
    """
    if len(forecast.sites) == 1:
        why = "; ".join(f"{site}: {why}" for site, why in absent.items()) or "no other site"
        return Decision(ONBOARD, why, ALONE)
    decision = policy.decide(forecast)
    if kind.duplicate:
        return decision
    if decision.both:
        # Warm-up without a second run: the site that is known least learns next.
        heard = [site for site in forecast.sites if site not in decision.spared]
        site = min(heard, key=lambda site: (known(site), site != ONBOARD))
        return Decision(site, f"{decision.reason}; never on two sites", decision.policy)
    return decision if decision.second is None else decision._replace(second=None)


def plan_of(
    decision: Decision, forecast: Forecast, call: "Future[str] | None" = None, *, hurried: bool = False
) -> Plan:
    """How the race carries out a decision; `call` may name one more site while the task runs.

    `hurried`: the call has a deadline. It gets the first answer, even if the policy waits for all sites.
    """
    second, first = decision.second, (decision.site,)
    if isinstance(second, Probe) and not second.answers:  # that run starts after the answer
        second = None
    plan = Plan(first, second, latest=decision.latest, call=call)
    if decision.both:
        plan.first = tuple(site for site in forecast.sites if site not in decision.spared)
        plan.all, plan.keep = decision.waits and (decision.policy == PINNED or not hurried), True
    if decision.both or isinstance(second, Probe):
        # A hedge waits for nothing: it starts because the chosen site is late by more than this.
        plan.lost_s = {site: one.quality.lost_s for site, one in forecast.sites.items()}
    return plan
