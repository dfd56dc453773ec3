"""The policies `onboard` and `cloud`: one site for every task.

They are the baselines that the other policies are compared with.
"""

from offboard.robot_client.policies.decision import Decision
from offboard.robot_client.policies.forecast import Forecast, home


class Always:
    """Runs every task on one site, or onboard while that site cannot take tasks."""

    def __init__(self, site: str) -> None:
        self._site = site

    def decide(self, forecast: Forecast) -> Decision:
        if self._site in forecast.sites:
            return Decision(self._site, f"always {self._site}", self._site)
        return Decision(home(forecast), f"{self._site} cannot take it", self._site)
