"""The runner of one server for one simulated robot: works as `CloudRunner`, with messages in virtual time.

What the server does with the messages is in `fleet_servers`.
"""

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field
from functools import partial

from offboard.common.errors import CloudTimeout, OffloadError, Overtaken
from offboard.common.tasks import Kind, Task
from offboard.loadgen.fleet.fleet_messages import BEAT, BEAT_REPLY, CANCEL, REQUEST, ToRobot, ToServer
from offboard.loadgen.simulation.model.simulated_cpu import SimulatedCpu
from offboard.loadgen.simulation.model.true_costs import TrueCosts
from offboard.loadgen.simulation.model.virtual_clock import VirtualClock
from offboard.robot_client.sites.heartbeat import EARLY_S, Heartbeat, ServerReport
from offboard.robot_client.sites.runner import CLOUD, Condition, Execution, Sending


@dataclass(frozen=True, slots=True)
class Place:
    """Which robot a runner belongs to, the server and the site that it stands for, and the delay."""

    robot: int
    server: int
    site: str
    delay_s: float


@dataclass(eq=False, slots=True)
class _Pending:
    task: Task
    published_s: float
    future: "Future[Execution]" = field(default_factory=Future)


class FleetSite:
    """A server, as one robot of the fleet uses it. `post` sends a message to it."""

    def __init__(
        self,
        place: Place,
        clock: VirtualClock,
        cpu: SimulatedCpu,
        costs: TrueCosts,
        *,
        post: Callable[[ToServer], object],
        heartbeat: Heartbeat,
    ) -> None:
        self.site = place.site
        self._place = place
        self._clock = clock
        self._cpu = cpu
        self._costs = costs
        self._post = post
        self._heartbeat = heartbeat
        self._pending: dict[int, _Pending] = {}
        self._heartbeat.start(clock.now_s())
        self._plan_beat()

    def unavailable(self, kind: Kind) -> str | None:  # noqa: ARG002 - the server knows every kind
        return None

    def submit(self, task: Task, budget_s: float) -> "Future[Execution]":
        now_s = self._clock.now_s()
        pending = self._pending[task.id] = _Pending(task, now_s)
        if self._heartbeat.due_s <= now_s + EARLY_S:
            self._beat()
        self._send(REQUEST, task.id, self.sending_s, self._costs.cpu_s(CLOUD, task), limit_s=now_s + budget_s)
        self._clock.after(budget_s, partial(self._expire, task.id))
        return pending.future

    def to_send(self, task: Task) -> Sending:  # noqa: ARG002 - all requests are small
        return Sending(self._costs.task(0).bytes_out)

    def cancel(self, task: Task) -> None:
        self._give_up(task.id, Overtaken("another site answered first"))

    def hurry(self) -> None:
        self._heartbeat.hurry(self._clock.now_s())
        self._plan_beat()

    def condition(self) -> Condition:
        return self._heartbeat.condition(self._clock.now_s())

    def close(self) -> None:
        self._heartbeat.stop()

    @property
    def sending_s(self) -> float:
        """How long the robot needs to pack and send a request, or to receive and unpack a reply."""
        return self._costs.cost.sending_s / 2 / self._cpu.share_of_one_more

    def receive(self, message: ToRobot) -> None:
        """A message of the server has arrived."""
        now_s, report = self._clock.now_s(), ServerReport(message.queue)
        if message.sort == BEAT_REPLY:
            self._heartbeat.answer(message.number, now_s, report)
            self._plan_beat()
            return
        self._heartbeat.hear(now_s, report)
        if message.number in self._pending:
            self._clock.after(self.sending_s, partial(self._take, message))

    def _take(self, message: ToRobot) -> None:
        """The robot has unpacked the answer."""
        pending = self._pending.pop(message.number, None)
        if pending is None:
            return
        seconds, task = self._clock.now_s() - pending.published_s, self._costs.task(0)
        pending.future.set_result(
            Execution(
                self.site,
                seconds,
                self._costs.value(pending.task),
                queue_s=message.queue_s,
                run_s=message.run_s,
                network_s=seconds - message.queue_s - message.run_s,
                cpu_s=message.run_s,
                bytes_out=task.bytes_out,
                bytes_in=task.bytes_in,
            )
        )

    def _expire(self, number: int) -> None:
        self._give_up(number, CloudTimeout("no answer in time"))

    def _give_up(self, number: int, failure: OffloadError) -> None:
        pending = self._pending.pop(number, None)
        if pending is None:
            return
        self._send(CANCEL, number)
        self.hurry()
        seconds = self._clock.now_s() - pending.published_s
        pending.future.set_result(Execution(self.site, seconds, failure=failure, censored=True))

    def _plan_beat(self) -> None:
        self._clock.at(self._heartbeat.due_s, self._beat_if_due)

    def _beat_if_due(self) -> None:
        if self._heartbeat.due_s <= self._clock.now_s():  # else it was sent with a task
            self._beat()

    def _beat(self) -> None:
        self._send(BEAT, self._heartbeat.beat(self._clock.now_s()))
        self._plan_beat()

    def _send(
        self, sort: int, number: int, after_s: float = 0.0, cpu_s: float = 0.0, *, limit_s: float = 0.0
    ) -> None:
        robot, server, delay_s = self._place.robot, self._place.server, self._place.delay_s
        arrives_s = self._clock.now_s() + after_s + delay_s
        self._post(ToServer(arrives_s, sort, robot, server, number=number, cpu_s=cpu_s, limit_s=limit_s))
