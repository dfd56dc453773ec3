"""Published bandit rules, which sometimes try a site that looks worse, in case it has become better.

`probe` reaches the same aim without making the caller wait for the worse site.
"""

from collections.abc import Mapping
from random import Random

from offboard.robot_client.policies import Decision, Forecast
from offboard.robot_client.policies.forecast import costs_of
from offboard.robot_client.policies.greedy import Greedy

BAYES = "offboard.loadgen.rivals.adaptive.BayesianLeastSquares"


class LinUcb:
    """LinUCB (Li et al., 2010): a site's cost counts as WIDTH standard errors lower than it is predicted."""

    predictor = BAYES
    WIDTH = 1.0

    def __init__(self, seed: int = 0) -> None:  # noqa: ARG002 - nothing is random
        self._greedy = Greedy()

    def decide(self, forecast: Forecast) -> Decision:
        costs = {site: cost - self.WIDTH * error_s for site, (cost, error_s) in _known(forecast).items()}
        return self._greedy.decide(_with_costs(forecast, costs))._replace(policy="linucb")


class Thompson:
    """Thompson sampling (Agrawal and Goyal, 2013): each cost is drawn around its prediction."""

    predictor = BAYES

    def __init__(self, seed: int = 0) -> None:
        self._greedy = Greedy()
        self._random = Random(seed)

    def decide(self, forecast: Forecast) -> Decision:
        costs = {
            site: self._random.gauss(cost, error_s) for site, (cost, error_s) in _known(forecast).items()
        }
        return self._greedy.decide(_with_costs(forecast, costs))._replace(policy="thompson")


def _known(forecast: Forecast) -> dict[str, tuple[float, float]]:
    """The cost of each site, and the standard error of its prediction."""
    costs = costs_of(forecast)
    return {site: (costs[site], one.error_s or 0.0) for site, one in forecast.sites.items()}


def _with_costs(forecast: Forecast, costs: Mapping[str, float]) -> Forecast:
    return forecast._replace(
        sites={site: one._replace(cost=costs[site]) for site, one in forecast.sites.items()}
    )
