"""The simulated runner of a server's site: works as `CloudRunner`, with modelled messages and no socket."""

from concurrent.futures import Future
from dataclasses import dataclass, field
from functools import partial

from offboard.common.errors import CloudBroken, CloudBusy, CloudTimeout, OffloadError, Overtaken
from offboard.common.tasks import Kind, Task
from offboard.loadgen.relay.link.link import Link
from offboard.loadgen.simulation.model.simulated_connection import SimulatedConnection
from offboard.loadgen.simulation.model.simulated_cpu import SimulatedCpu
from offboard.loadgen.simulation.model.simulated_direction import Message
from offboard.loadgen.simulation.model.simulated_server import BUSY, NEED_BLOB, Key, Reply, SimulatedServer
from offboard.loadgen.simulation.model.task_costs import (
    BEAT_BYTES,
    BEAT_REPLY_BYTES,
    CANCEL_BYTES,
    MISSING_BYTES,
)
from offboard.loadgen.simulation.model.true_costs import TrueCosts, number_of
from offboard.loadgen.simulation.model.virtual_clock import VirtualClock
from offboard.loadgen.testbed.testbed import ROBOT
from offboard.robot_client.sites.cloud import PENDING_MAX
from offboard.robot_client.sites.heartbeat import EARLY_S, Heartbeat, ServerReport
from offboard.robot_client.sites.runner import CLOUD, Condition, Execution, Sending

TASK, BEAT, CANCEL, BLOB = "task", "beat", "cancel", "blob"  # sorts of messages


@dataclass(eq=False, slots=True)
class _Pending:
    """A request without an answer so far."""

    call: Task
    published_s: float
    deadline_s: float
    attempt: int = 1
    bytes_out: int = 0
    future: "Future[Execution]" = field(default_factory=Future)

    @property
    def number(self) -> int:
        return number_of(self.call)


class SimulatedCloud:
    """A server, as the first robot uses it.

    - `site`: its name.
    - `cpu`: the CPU of the robot, which packs and unpacks the messages.
    - `heartbeat_s`: time between heartbeats; 0 means none.
    """

    def __init__(
        self,
        clock: VirtualClock,
        server: SimulatedServer,
        cpu: SimulatedCpu,
        costs: TrueCosts,
        *,
        site: str,
        link: Link,
        seed: int,
        heartbeat_s: float,
    ) -> None:
        self.site = site
        self.connection = SimulatedConnection(
            clock, server, link, seed, on_up=self._start_beating, on_lost=self._fail_all
        )
        self._clock = clock
        self._server = server
        self._cpu = cpu
        self._costs = costs
        self._pending: dict[int, _Pending] = {}
        self._heartbeat = Heartbeat(heartbeat_s, seed)
        self._start_beating()

    def unavailable(self, kind: Kind) -> str | None:  # noqa: ARG002 - the server knows every kind
        return None if self.connection.up else "not connected"

    def submit(self, task: Task, budget_s: float) -> "Future[Execution]":
        now_s = self._clock.now_s()
        pending = _Pending(task, now_s, now_s + budget_s)
        if not self.connection.up:
            self._end(pending, CloudBroken("nothing can be sent"), started=False)
        elif len(self._pending) >= PENDING_MAX:
            self._end(pending, CloudBusy(f"{PENDING_MAX} tasks are in flight"), started=False)
        else:
            self._pending[task.id] = pending
            if self._heartbeat.due_s <= now_s + EARLY_S:
                self._send_beat()
            self._clock.after(self.sending_s, partial(self._send, pending))
            self._clock.at(pending.deadline_s, partial(self._expire, pending))
        return pending.future

    def to_send(self, task: Task) -> Sending:
        return Sending(self._costs.task(number_of(task)).bytes_out)

    def cancel(self, task: Task) -> None:
        pending = self._pending.get(task.id)
        if pending is not None:
            self._give_up(pending, Overtaken("another site answered first"))

    def hurry(self) -> None:
        self._hurry()

    def condition(self) -> Condition:
        return self._heartbeat.condition(self._clock.now_s())

    def close(self) -> None:
        pass

    @property
    def sending_s(self) -> float:
        """How long the robot needs now to pack and send a request, or to receive and unpack a reply."""
        return self._costs.cost.sending_s / 2 / self._cpu.share_of_one_more

    def _send(self, pending: _Pending) -> None:
        if not self._waits(pending):
            return
        size = self._costs.task(pending.number).bytes_out
        pending.bytes_out += size
        budget_s = pending.deadline_s - self._clock.now_s()
        cpu_s = self._costs.cpu_s(CLOUD, pending.call)
        reply = partial(self._reply, pending)
        request = partial(
            self._server.request, self._key(pending), cpu_s=cpu_s, budget_s=budget_s, answer=reply
        )
        self.connection.send(Message(size, f"{TASK}{pending.attempt}", pending.number), request)

    def _reply(self, pending: _Pending, reply: Reply) -> None:
        """The server sends a reply."""
        size = MISSING_BYTES
        if reply.status not in (BUSY, NEED_BLOB):
            size = self._costs.task(pending.number).bytes_in
        message = Message(size, f"{TASK}{pending.attempt}", pending.number)
        self.connection.reply(message, partial(self._receive, pending, reply, size))

    def _receive(self, pending: _Pending, reply: Reply, size: int) -> None:
        """The reply arrives at the robot."""
        self._heartbeat.hear(self._clock.now_s(), reply.told)
        self._clock.after(self.sending_s, partial(self._take, pending, reply, size))

    def _take(self, pending: _Pending, reply: Reply, size: int) -> None:
        """The robot has unpacked the reply."""
        if not self._waits(pending):
            return
        if reply.status == NEED_BLOB:
            blob_bytes = self._costs.blob_bytes
            self.connection.send(Message(blob_bytes, BLOB, pending.number), self._server.take_blob)
            pending.bytes_out += blob_bytes
            pending.attempt += 1
            self._send(pending)
        elif reply.status == BUSY:
            self._end(pending, CloudBusy(f"{reply.told.queue} requests are waiting"), started=False)
        else:
            self._end_well(pending, reply, size)

    def _end_well(self, pending: _Pending, reply: Reply, size: int) -> None:
        del self._pending[pending.call.id]
        seconds = self._clock.now_s() - pending.published_s
        pending.future.set_result(
            Execution(
                self.site,
                seconds,
                self._costs.value(pending.call),
                queue_s=reply.queue_s,
                run_s=reply.run_s,
                network_s=max(0.0, seconds - reply.queue_s - reply.run_s),
                cpu_s=reply.cpu_s,
                bytes_out=pending.bytes_out,
                bytes_in=size,
            )
        )

    def _expire(self, pending: _Pending) -> None:
        if self._waits(pending):
            self._give_up(pending, CloudTimeout("no answer within the budget"))

    def _give_up(self, pending: _Pending, failure: OffloadError) -> None:
        """Cancel a request whose answer is not needed any more."""
        cancel = partial(self._server.cancel, self._key(pending))
        self.connection.send(Message(CANCEL_BYTES, CANCEL, pending.number), cancel)
        self._end(pending, failure, censored=True)
        self._hurry()

    def _hurry(self) -> None:
        self._heartbeat.hurry(self._clock.now_s())
        self._plan_beat()

    def _plan_beat(self) -> None:
        self._clock.at(self._heartbeat.due_s, self._beat_if_due)

    def _end(
        self, pending: _Pending, failure: OffloadError, *, censored: bool = False, started: bool = True
    ) -> None:
        self._pending.pop(pending.call.id, None)
        seconds = self._clock.now_s() - pending.published_s
        pending.future.set_result(
            Execution(
                self.site,
                seconds,
                failure=failure,
                censored=censored,
                bytes_out=pending.bytes_out,
                started=started,
            )
        )

    def _fail_all(self) -> None:
        self._heartbeat.stop()
        for pending in list(self._pending.values()):
            self._end(pending, CloudBroken("the connection was lost"))

    def _waits(self, pending: _Pending) -> bool:
        return self._pending.get(pending.call.id) is pending

    def _key(self, pending: _Pending) -> Key:
        return ROBOT, pending.call.id

    def _start_beating(self) -> None:
        self._heartbeat.start(self._clock.now_s())
        self._plan_beat()

    def _beat_if_due(self) -> None:
        if (
            self._heartbeat.due_s <= self._clock.now_s()
        ):  # else it was sent with a task, or no longer connected
            self._send_beat()

    def _send_beat(self) -> None:
        number = self._heartbeat.beat(self._clock.now_s())
        self.connection.send(Message(BEAT_BYTES, BEAT, number), partial(self._reply_to_beat, number))
        self._plan_beat()

    def _reply_to_beat(self, number: int) -> None:
        arrive = partial(self._beat_replied, number, self._server.told)
        self.connection.reply(Message(BEAT_REPLY_BYTES, BEAT, number), arrive)

    def _beat_replied(self, number: int, told: ServerReport) -> None:
        self._heartbeat.answer(number, self._clock.now_s(), told)
        self._plan_beat()
