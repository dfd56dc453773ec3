"""The policies that others are compared with: one site for every task, and the published rule.

The windows and the least squares that the rule was published with are in `predictors`.
"""

from collections.abc import Mapping
from functools import partial

from offboard.common.variants import group_of
from offboard.common.wording import duration
from offboard.robot_client.policies.decision import Decision
from offboard.robot_client.policies.forecast import Forecast, cheapest, costs_of, home


class Always:
    """Runs every task on one site, or the cheapest one of a group of this name.

    While none of them can take tasks, tasks run onboard.
    """

    def __init__(self, site: str) -> None:
        self._site = site

    def decide(self, forecast: Forecast) -> Decision:
        sites = [site for site in forecast.sites if group_of(site) == self._site]
        if sites:
            site = cheapest(costs_of(forecast.only(sites)))
            return Decision(site, f"always {self._site}", self._site)
        return Decision(home(forecast), f"{self._site} cannot take it", self._site)


class Paper:
    """Algorithm 1 of Penmetcha, Kannan and Min, exactly.

    Runs each task on the site with the lowest prediction, after a warm-up on all sites.
    """

    def decide(self, forecast: Forecast) -> Decision:
        cold = [site for site, outlook in forecast.sites.items() if not outlook.full]
        if cold:
            # Algorithm 1, warm-up branch: both sites, until both queues are full.
            reason = f"warm-up: the window of {' and '.join(sorted(cold))} is not full"
            both = len(forecast.sites) > 1
            return Decision(home(forecast), reason, "paper", both=both, waits=both)
        predicted = {site: outlook.predicted_s or 0.0 for site, outlook in forecast.sites.items()}
        # Eq. 1: the cloud only where it is strictly faster; a tie stays onboard.
        site = cheapest(predicted)
        return Decision(site, partial(_compared, predicted, site), "paper")


def _compared(predicted: Mapping[str, float], site: str) -> str:
    names = [site, *(name for name in predicted if name != site)]
    return " against ".join(f"{name} {duration(predicted[name])}" for name in names)
