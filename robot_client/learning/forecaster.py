"""The step before a decision: what each site should take for a task.

The times come from the memories; what is measured of the sites comes from the runners in `sites`.
"""

from collections.abc import Mapping

from offboard.common.tasks import Size, Task
from offboard.robot_client.learning.kind import KindMemory
from offboard.robot_client.learning.runs_in_flight import Flights
from offboard.robot_client.policies import Forecast, Outlook
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
        self, memory: KindMemory, task: Task, sites: Mapping[str, Runner], *, now_s: float
    ) -> Forecast:
        """The forecast of one task on these sites, behind all runs that are under way."""
        amount, outlooks, packs = memory.amount(task.size), {}, task.kind.pack is not None
        for site, runner in sites.items():
            known, in_flight = memory.site(site), self._flights.count(site)
            sending = runner.to_send(task)
            outlooks[site] = known.outlook(
                amount,
                self._behind(runner, in_flight, now_s) if known.measured else UNMEASURED,
                in_flight=in_flight,
                under_way=in_flight > 0 and self._flights.has(site, task.kind.name),
                sending=sending,
                # Most tasks have nothing to make smaller, so that is asked first.
                packing=memory.packing.plan(sending, known.model.byte_s) if packs or sending.large else None,
            )
        return self._finished(memory, task.size, outlooks)

    def forecast_in_batch(self, memory: KindMemory, task: Task, own: Mapping[Runner, int]) -> Forecast:
        """The forecast of a task in a batch, without the wait for the batch's own tasks.

        `own` holds the runners that may be used, and how many tasks of the batch each of them has.
        """
        amount, outlooks, packs = memory.amount(task.size), {}, task.kind.pack is not None
        for runner, count in own.items():
            known, sending = memory.site(runner.site), runner.to_send(task)
            outlooks[runner.site] = known.outlook(
                amount,
                _apart_from(runner, count) if known.measured else UNMEASURED,
                in_flight=count,
                under_way=count > 0,
                sending=sending,
                packing=memory.packing.plan(sending, known.model.byte_s) if packs or sending.large else None,
            )
        return self._finished(memory, task.size, outlooks)

    def _finished(self, memory: KindMemory, size: Size, outlooks: Mapping[str, Outlook]) -> Forecast:
        allowance = self._allowance
        duplicates = allowance.duplicates if memory.kind.duplicate else 0.0
        forecast = Forecast(size, outlooks, memory.last_site, duplicates)
        if allowance.capped:
            forecast = forecast._replace(bytes_left=allowance.bytes_left, joules_left=allowance.joules_left)
        return self._weighing.weighed(forecast, capped=allowance.capped)

    def _behind(self, runner: Runner, in_flight: int, now_s: float) -> Condition:
        """The condition of a site behind the runs under way there.

        Onboard runs one task at a time. The queue of a server may not yet count what was sent to it.
        """
        condition = runner.condition()
        if not in_flight:
            return condition
        if runner.site != ONBOARD:
            return condition._replace(queue=max(condition.queue, in_flight))
        return condition._replace(wait_s=self._flights.left_s(runner.site, now_s))


def _apart_from(runner: Runner, own: int) -> Condition:
    condition = runner.condition()
    return condition._replace(queue=max(0, condition.queue - own))
