"""The step before a decision: what each site should take for a task.

The times come from the memories; what is measured of the sites comes from the runners in `sites`.
"""

from collections.abc import Mapping

from offboard.common.tasks import Task
from offboard.robot_client.learning.kind import KindMemory
from offboard.robot_client.learning.runs_in_flight import Flights
from offboard.robot_client.policies import Forecast
from offboard.robot_client.policies.allowance import Allowance
from offboard.robot_client.policies.objectives import Weighing
from offboard.robot_client.sites.runner import ONBOARD, UNMEASURED, Condition, Runner


class Forecaster:
    """Makes forecasts. Called under the offloader's lock."""

    def __init__(self, flights: Flights, allowance: Allowance, weighing: Weighing) -> None:
        self._flights = flights
        self._allowance = allowance
        self._weighing = weighing

    def forecast(
        self,
        memory: KindMemory,
        task: Task,
        sites: Mapping[str, Runner],
        *,
        now_s: float,
        own: Mapping[str, int] | None = None,
    ) -> Forecast:
        """The forecast of one task on these sites, behind all runs that are under way.

        `own`: for a task of a batch, how many of its tasks each site has. It does not wait for those here.
        """
        amount, outlooks, packs = memory.amount(task.size), {}, task.kind.pack is not None
        for site, runner in sites.items():
            known, sending, condition = memory.site(site), runner.to_send(task), UNMEASURED
            in_flight = self._flights.count(site) if own is None else own[site]
            if known.measured:
                condition = runner.condition()
                if own is not None:
                    condition = condition._replace(queue=max(0, condition.queue - in_flight))
                elif in_flight:
                    condition = self._behind(site, condition, in_flight, now_s)
            outlooks[site] = known.outlook(
                amount,
                condition,
                in_flight=in_flight,
                under_way=in_flight > 0 and (own is not None or self._flights.has(site, task.kind.name)),
                sending=sending,
                # Most tasks have nothing to make smaller, so that is asked first.
                packing=memory.packing.plan(sending, known.model.byte_s) if packs or sending.large else None,
            )
        allowance = self._allowance
        duplicates = allowance.duplicates if memory.kind.duplicate else 0.0
        forecast = Forecast(task.size, outlooks, memory.last_site, duplicates)
        if allowance.capped:
            forecast = forecast._replace(bytes_left=allowance.bytes_left, joules_left=allowance.joules_left)
        return self._weighing.weighed(forecast, capped=allowance.capped)

    def _behind(self, site: str, condition: Condition, in_flight: int, now_s: float) -> Condition:
        """The condition of a site behind the runs under way there.

        Onboard runs one task at a time. The queue of a server may not yet count what was sent to it.
        """
        if site == ONBOARD:
            return condition._replace(wait_s=self._flights.left_s(site, now_s))
        return condition._replace(queue=max(condition.queue, in_flight))
