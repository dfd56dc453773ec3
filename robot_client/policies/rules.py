"""Rules that compare what the sites would cost."""

from collections.abc import Callable, Mapping
from functools import partial
from random import Random

from offboard.robot_client.policies.decision import Decision, Policy
from offboard.robot_client.policies.forecast import Forecast, Outlook, cheapest, costs_of, home
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, Condition

WARM_UP = 6  # observations of each site before anything is compared
MARGIN = 0.1
EPSILON = 0.05


class Paper:
    """Algorithm 1 of Penmetcha, Kannan and Min, exactly."""

    def decide(self, forecast: Forecast) -> Decision:
        cold = [site for site, outlook in forecast.sites.items() if not outlook.full]
        if cold:
            # Algorithm 1, warm-up branch: both sites, until both queues are full.
            reason = f"warm-up: the window of {' and '.join(sorted(cold))} is not full"
            return Decision(home(forecast), reason, "paper", both=len(forecast.sites) > 1)
        predicted = {site: outlook.predicted_s or 0.0 for site, outlook in forecast.sites.items()}
        # Eq. 1: the cloud only where it is strictly faster; a tie stays onboard.
        site = cheapest(predicted)
        return Decision(site, partial(_compared, predicted, site), "paper")


class Always:
    """One site for every task; onboard where that site cannot take it."""

    def __init__(self, site: str) -> None:
        self._site = site

    def decide(self, forecast: Forecast) -> Decision:
        if self._site in forecast.sites:
            return Decision(self._site, f"always {self._site}", self._site)
        return Decision(home(forecast), f"{self._site} cannot take it", self._site)


class Greedy:
    """The site that should cost least, from the first few observations of each on."""

    name = "greedy"

    def decide(self, forecast: Forecast) -> Decision:
        if (warming := warm_up(forecast, self.name)) is not None:
            return warming
        site = self._choose(forecast, costs_of(forecast))
        return Decision(site, partial(explain, forecast, site), self.name)

    def _choose(self, forecast: Forecast, costs: dict[str, float]) -> str:  # noqa: ARG002 - leaves look at it
        return cheapest(costs)


class Hysteresis(Greedy):
    """Stays where it is until another site costs less by MARGIN: no flapping between equals."""

    name = "hysteresis"

    def _choose(self, forecast: Forecast, costs: dict[str, float]) -> str:
        best, last = cheapest(costs), forecast.last_site
        if last in costs and costs[best] > (1 - MARGIN) * costs[last]:
            return last
        return best


class Epsilon(Greedy):
    """Epsilon-greedy: one task in 1 / EPSILON goes to a site drawn evenly from the others that are heard."""

    name = "epsilon"

    def __init__(self, random: Random) -> None:
        self._random = random

    def _choose(self, forecast: Forecast, costs: dict[str, float]) -> str:
        best = cheapest(costs)
        others = [site for site in costs if site != best and not forecast.sites[site].condition.silent]
        if others and self._random.random() < EPSILON:
            return self._random.choice(others)
        return best


class LinUcb(Greedy):
    """Optimism: the cost less WIDTH standard errors of what is known of it (Li et al. 2010, LinUCB)."""

    name = "linucb"
    WIDTH = 1.0

    def _choose(self, forecast: Forecast, costs: dict[str, float]) -> str:
        return cheapest(
            {site: costs[site] - self.WIDTH * (one.error_s or 0.0) for site, one in forecast.sites.items()}
        )


class Thompson(Greedy):
    """Thompson sampling: the cost drawn from what is believed of it (Agrawal and Goyal 2013)."""

    name = "thompson"

    def __init__(self, random: Random) -> None:
        self._random = random

    def _choose(self, forecast: Forecast, costs: dict[str, float]) -> str:
        return cheapest(
            {
                site: self._random.gauss(costs[site], one.error_s or 0.0)
                for site, one in forecast.sites.items()
            }
        )


def _compared(predicted: Mapping[str, float], site: str) -> str:
    names = [site, *(name for name in predicted if name != site)]
    return " against ".join(f"{name} {predicted[name] * 1e3:.1f} ms" for name in names)


def warm_up(forecast: Forecast, policy: str) -> Decision | None:
    """All sites but silent ones, while one of them has too few observations."""
    if all(one.observations >= WARM_UP for one in forecast.sites.values()):
        return None
    heard = {site: one for site, one in forecast.sites.items() if not one.condition.silent}
    cold = [
        site for site, one in heard.items() if one.observations < WARM_UP and not (one.full or one.in_flight)
    ]
    if not cold or len(heard) == 1:
        return None
    reason = f"warm-up: too little is known of {' and '.join(sorted(cold))}"
    silent = tuple(site for site in forecast.sites if site not in heard)
    return Decision(home(forecast.only(heard)), reason, policy, both=True, spared=silent)


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


RULES: dict[str, Callable[[Random], Policy]] = {
    "paper": lambda _: Paper(),
    ONBOARD: lambda _: Always(ONBOARD),
    CLOUD: lambda _: Always(CLOUD),
    "greedy": lambda _: Greedy(),
    "hysteresis": lambda _: Hysteresis(),
    "epsilon": Epsilon,
    "linucb": lambda _: LinUcb(),
    "thompson": Thompson,
}
