"""The policies `onboard` and `cloud`: one site for every task.

They are the baselines that the other policies are compared with.
"""

from offboard.common.variants import group_of
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
