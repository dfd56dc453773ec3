"""Rules that sometimes try a site that looks worse, to find out whether it has become better.

`probe` reaches the same aim without making the caller wait for the worse site.
"""

from random import Random

from offboard.robot_client.policies.forecast import Forecast, cheapest
from offboard.robot_client.policies.greedy import Greedy

EPSILON = 0.05


class Epsilon(Greedy):
    """Epsilon-greedy: one task in 1 / EPSILON goes to another site that is not silent, drawn evenly."""

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
    """LinUCB (Li et al., 2010): a site's cost counts as WIDTH standard errors lower than it is predicted."""

    name = "linucb"
    WIDTH = 1.0

    def _choose(self, forecast: Forecast, costs: dict[str, float]) -> str:
        return cheapest(
            {site: costs[site] - self.WIDTH * (one.error_s or 0.0) for site, one in forecast.sites.items()}
        )


class Thompson(Greedy):
    """Thompson sampling (Agrawal and Goyal, 2013): each cost is drawn around its prediction."""

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
