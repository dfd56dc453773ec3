"""What a policy decides from, and what it decides."""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

from offboard.robot_client.learning.intervals import Conformal
from offboard.robot_client.sites.runner import ONBOARD, UNMEASURED, Condition

OVERDUE_SD = 2.0  # standard deviations beyond its prediction, while too few errors are known


@dataclass(slots=True)
class Outlook:
    """What is known of one site before a task.

    `predicted_s` and `spread_s` (None: nothing learnt); `full`: the predictor's warm-up is over; `age`: tasks
    of this kind since the site last ran one; `failures`: in a row; `count`: observations that the prediction
    rests on; `low_s`, `high_s`: its 90 % interval; `error_s`: the standard error of the prediction itself;
    `cost`: what the objective makes of it (None: nothing learnt); `in_flight`: tasks of any kind there now;
    `bytes` and `joules`: what running there is expected to take; `condition`: what was measured; `errors`:
    those of the predictions so far; `smallest`: the site ran no task nearly as small as this one.
    """

    predicted_s: float | None
    spread_s: float | None
    full: bool
    age: int
    failures: int
    count: int = 0
    low_s: float | None = None
    high_s: float | None = None
    error_s: float | None = None
    cost: float | None = None
    in_flight: int = 0
    bytes: float = 0.0
    joules: float = 0.0
    condition: Condition = UNMEASURED
    errors: Conformal | None = None
    smallest: bool = False

    def overdue_s(self, worth_s: float) -> float | None:
        """When a task that has not come back is expected to need more than `worth_s` still."""
        if self.predicted_s is None:
            return None
        after_s = None if self.errors is None else self.errors.overdue(self.predicted_s, worth_s)
        if after_s is not None:
            return after_s
        return None if self.spread_s is None else self.predicted_s + OVERDUE_SD * self.spread_s


@dataclass(slots=True)
class Forecast:
    """The size of a task and the outlook of every site that can take it now.

    Onboard is always one; a wrapper may leave it out for those that it holds.

    `last_site`: where the last task of this kind was sent; `duplicates`: second runs that may begin now;
    `bytes_left` and `joules_left`: what the caps leave.
    """

    size: float
    sites: Mapping[str, Outlook]
    last_site: str | None = None
    duplicates: float = math.inf
    bytes_left: float = math.inf
    joules_left: float = math.inf

    def only(self, sites: Collection[str]) -> "Forecast":
        """The same with these sites alone."""
        return replace(self, sites={name: one for name, one in self.sites.items() if name in sites})


def cheapest(costs: Mapping[str, float]) -> str:
    """The site of the least cost; a tie stays onboard."""
    least = min(costs.values())
    if costs.get(ONBOARD) == least:
        return ONBOARD
    return next(site for site, cost in costs.items() if cost == least)


def cost_of(outlook: Outlook) -> float:
    """What a site would cost; 0 where nothing is known, so that it gets known, unless it is silent."""
    if outlook.cost is not None:
        return outlook.cost
    if outlook.predicted_s is None:
        return math.inf if outlook.condition.silent else 0.0
    return outlook.predicted_s


def costs_of(forecast: Forecast) -> dict[str, float]:
    """By site."""
    return {site: cost_of(one) for site, one in forecast.sites.items()}


def home(forecast: Forecast) -> str:
    """Onboard; where a wrapper left that out, the cheapest of the others."""
    return ONBOARD if ONBOARD in forecast.sites else cheapest(costs_of(forecast))


def explain(forecast: Forecast, site: str) -> str:
    """Why this site: each one's prediction with its interval, what was measured, how stale the others are."""
    sites = forecast.sites
    parts, stale = [f"{site}: {_times(sites[site])}"], ""
    measured = f"size {forecast.size:.3g}"
    for name, one in sites.items():
        if name != site:
            parts.append(f"{name} {_times(one)}")
            if one.age:
                stale += f"; {name} last tried {one.age} tasks ago"
        measured += _measured(name, one.condition, "" if len(sites) == 2 else f" {name}")
    return f"{' against '.join(parts)}; {measured}{stale}"


def _times(one: Outlook) -> str:
    if one.condition.silent:
        return "silent"
    if one.predicted_s is None:
        return "unknown"
    if one.low_s is None or one.high_s is None:
        return f"{one.predicted_s * 1e3:.3g} ms"
    return f"{one.predicted_s * 1e3:.3g} ms [{one.low_s * 1e3:.3g}, {one.high_s * 1e3:.3g}]"


def _measured(site: str, condition: Condition, of: str) -> str:
    said, there = "", of if of or site == ONBOARD else " there"
    if condition.round_trip_s is not None:
        said = f", queue{of} {condition.queue}, rtt{of} {condition.round_trip_s * 1e3:.3g} ms"
    if site == ONBOARD and condition.load >= 0.005:
        said += f", load{of} {condition.load:.0%}"
    if condition.server_load >= 0.005:
        said += f", load{there} {condition.server_load:.0%}"
    if condition.capacity < 1.0:
        said += f", capacity{there} {condition.capacity:.0%}"
    if condition.wait_s:
        said += f", wait{of} {condition.wait_s * 1e3:.3g} ms"
    return said
