"""What is measured of the sites: before a task, and again when its answer was late or early.

The measurements themselves are made by the runners in `sites`.
"""

from collections.abc import Mapping

from offboard.common.host.load import LOADED
from offboard.robot_client.policies import Outlook
from offboard.robot_client.sites.runner import ONBOARD, Condition, Execution, Runner

FREED = 0.5  # of the predicted time: a robot that is this fast may have got its CPU back


class Conditions:
    """The conditions of all sites."""

    def __init__(self, runners: Mapping[str, Runner]) -> None:
        self._runners = runners

    def now(self, site: str) -> Condition:
        """The condition of a site; that of a server includes the load of the robot, if it matters there."""
        condition = self._runners[site].condition()
        if site != ONBOARD and (load := self._load(site)):
            return condition._replace(load=load)
        return condition

    def held_up(self, site: str) -> bool:
        """Whether the site does not answer heartbeats, or may be about to."""
        condition = self._runners[site].condition()
        return condition.silent or condition.wait_s > 0

    def in_hindsight(self, outlook: Outlook, execution: Execution) -> Outlook:
        """The outlook with the load and capacity of now, if the measured time shows that they changed."""
        if not execution.ok or outlook.low_s is None or outlook.high_s is None:
            return outlook
        onboard = execution.site == ONBOARD
        later, sooner = execution.seconds > outlook.high_s, execution.seconds < outlook.low_s
        if not onboard and (later or sooner):
            outlook = self._as_the_server_says(execution.site, outlook, later=later)
        before = outlook.condition
        unexpected = later if before.load <= LOADED else sooner
        freed = onboard and sooner and execution.seconds < FREED * (outlook.predicted_s or 0.0)
        if not (unexpected or freed):
            return outlook
        self._runners[ONBOARD].hurry()
        load = self._load(execution.site) if unexpected else before.load
        capacity = self._capacity(before.capacity, later=later) if onboard else before.capacity
        if (load, capacity) == (before.load, before.capacity):
            return outlook
        return outlook._replace(condition=before._replace(load=load, capacity=capacity))

    def _capacity(self, before: float, *, later: bool) -> float:
        """The capacity of the robot now, as far as it explains a run that was late or early."""
        now = self._runners[ONBOARD].condition().capacity
        return min(before, now) if later else max(before, now)

    def _load(self, site: str) -> float:
        """The load of the robot; for a server only while it is so high that it changes the server's times."""
        load = self._runners[ONBOARD].condition().load
        return load if site == ONBOARD or load > LOADED else 0.0

    def _as_the_server_says(self, site: str, outlook: Outlook, *, later: bool) -> Outlook:
        """The outlook with what the server reported in its late, or early, answer."""
        before, now = outlook.condition, self._runners[site].condition()
        worse, better = (max, min) if later else (min, max)
        load = worse(before.server_load, now.server_load)
        capacity = better(before.capacity, now.capacity)
        return outlook._replace(condition=before._replace(server_load=load, capacity=capacity))
