"""Wrappers: policies around a policy."""

import math
from collections.abc import Callable, Collection
from dataclasses import replace

from offboard.robot_client.policies import decision as decided
from offboard.robot_client.policies.decision import Decision, Policy
from offboard.robot_client.policies.forecast import Forecast, Outlook, cheapest
from offboard.robot_client.sites.runner import ONBOARD

PROBE_EVERY = 20  # tasks without news of a site
MEASURED = 2.0  # times more seldom is onboard tried: its load and its capacity are measured
SELDOM_MAX = 8.0  # times more seldom, at most
STALE = round(PROBE_EVERY * SELDOM_MAX)  # tasks without news after which every site is tried
RESERVED = 1  # second runs that are left for hedges
HEDGE_MIN_S = 1e-3  # that the first site always has
BREAK_AFTER = 3  # failures in a row
BROKEN_FOR, BROKEN_MAX = 10, 160  # tasks: after the first break, doubling, at most


class Probe:
    """Runs a task in the shadow on a site that nothing was heard of for PROBE_EVERY tasks.

    The first answer is used, and both times are learnt: nobody waits for what is only tried. A site whose
    heartbeats go unanswered is not tried: the first one that is answered says more. Onboard, where a run
    takes the time of the tasks beside it, is tried more seldom, by the square of how much slower it is
    expected to be: a run takes the longer, and is the less likely to show that it is the better site; but at
    once with a task that is far smaller than all it ran, which is soon over and not to be foretold.
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
        return replace(decision, second=decided.Probe(stalest), why=f"{decision.reason}; {stalest} is probed")


class Hedge:
    """Starts a second site when waiting for the first is expected to take longer than the second.

    Dean and Barroso, The Tail at Scale (2013), where the wait is a quantile; here the site's own late tasks
    tell when one more that is late is better run elsewhere too.
    """

    def __init__(self, inner: Policy) -> None:
        self._inner = inner

    def decide(self, forecast: Forecast) -> Decision:
        decision = self._inner.decide(forecast)
        if decision.both or decision.second or forecast.duplicates < 1:
            return decision
        others = {
            site: one.predicted_s
            for site, one in forecast.sites.items()
            if site != decision.site and one.predicted_s is not None and not one.condition.silent
        }
        if not others:
            return decision
        second = cheapest(others)
        after_s = forecast.sites[decision.site].overdue_s(others[second])
        if after_s is None:
            return decision
        hedge = decided.Hedge(second, max(after_s, HEDGE_MIN_S))
        return Decision(decision.site, decision.why, decision.policy, second=hedge)


class Breaker:
    """A circuit breaker: a site that failed BREAK_AFTER times in a row gets no tasks for a while.

    The while is counted in tasks and doubles with each further failure (Nygard, Release It!).
    """

    def __init__(self, inner: Policy) -> None:
        self._inner = inner

    def decide(self, forecast: Forecast) -> Decision:
        left = [
            site
            for site, one in forecast.sites.items()
            if site == ONBOARD or not _broken(one.failures, one.age)
        ]
        return _among(left or forecast.sites.keys(), forecast, self._inner)


class Budget:
    """Leaves out the sites for which the caps on bytes and joules a minute leave too little.

    Where no site is left for, onboard it is: the task must be answered.
    """

    def __init__(self, inner: Policy) -> None:
        self._inner = inner

    def decide(self, forecast: Forecast) -> Decision:
        fit = [site for site in forecast.sites if _fits(forecast, {site})] or [ONBOARD]
        decision = _among(fit, forecast, self._inner)
        if decision.both and not _fits(forecast, forecast.sites.keys() - decision.spared):
            return replace(decision, both=False, spared=(), why=f"{decision.reason}; the caps leave one site")
        if decision.second is not None and not _fits(forecast, {decision.site, decision.second.site}):
            return replace(decision, second=None)
        return decision


def _among(sites: Collection[str], forecast: Forecast, inner: Policy) -> Decision:
    """What `inner` decides on these sites alone; the others are spared where it wants all."""
    decision = inner.decide(forecast.only(sites))
    if not decision.both:
        return decision
    left_out = [site for site in forecast.sites if site not in sites]
    return replace(decision, spared=(*decision.spared, *left_out))


def _fits(forecast: Forecast, sites: Collection[str]) -> bool:
    """Whether the caps leave enough for all of them."""
    taken = [forecast.sites[site] for site in sites]
    return (
        math.fsum(one.bytes for one in taken) <= forecast.bytes_left
        and math.fsum(one.joules for one in taken) <= forecast.joules_left
    )


def _probe_after(site: str, one: Outlook, chosen: Outlook) -> float:
    """Tasks without news of this site."""
    if site == ONBOARD and one.smallest:
        return 0.0
    if site != ONBOARD or not one.predicted_s or not chosen.predicted_s:
        return PROBE_EVERY
    return PROBE_EVERY * min(MEASURED * max(1.0, one.predicted_s / chosen.predicted_s) ** 2, SELDOM_MAX)


def _broken(failures: int, age: int) -> bool:
    if failures < BREAK_AFTER:
        return False
    doublings = min(failures - BREAK_AFTER, BROKEN_MAX.bit_length())
    return age < min(BROKEN_MAX, BROKEN_FOR << doublings)


WRAPPERS: dict[str, Callable[[Policy], Policy]] = {
    "probe": Probe,
    "hedge": Hedge,
    "breaker": Breaker,
    "budget": Budget,
}
