"""The runner of the cloud in a simulation: `CloudRunner` with modelled messages in place of a socket."""

from concurrent.futures import Future
from dataclasses import dataclass, field
from functools import partial

from offboard.common.errors import CloudBroken, CloudBusy, CloudTimeout, OffloadError, Overtaken
from offboard.common.tasks import Kind, Task
from offboard.loadgen.relay.link.link import Link
from offboard.loadgen.simulation.model.clock import VirtualClock
from offboard.loadgen.simulation.model.costs import BEAT_BYTES, BEAT_REPLY_BYTES, CANCEL_BYTES, MISSING_BYTES
from offboard.loadgen.simulation.model.processor import Processor
from offboard.loadgen.simulation.model.robot_connection import Connection
from offboard.loadgen.simulation.model.server import BUSY, NEED_BLOB, Key, Reply, Server
from offboard.loadgen.simulation.model.true_costs import Truth, number_of
from offboard.loadgen.testbed.testbed import ROBOT
from offboard.robot_client.sites.cloud import PENDING_MAX
from offboard.robot_client.sites.heartbeat import EARLY_S, Heartbeat, ServerReport
from offboard.robot_client.sites.own_cpu import OwnCpu
from offboard.robot_client.sites.runner import CLOUD, Condition, Execution

TASK, BEAT, CANCEL, BLOB = "task", "beat", "cancel", "blob"  # sorts of messages


@dataclass(eq=False, slots=True)
class _Pending:
    """A request in flight."""

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
    """Of the first robot, whose CPU packs and unpacks the messages. `heartbeat_s` 0: there are none."""

    site = CLOUD

    def __init__(
        self,
        clock: VirtualClock,
        server: Server,
        robot: Processor,
        truth: Truth,
        link: Link,
        seed: int,
        heartbeat_s: float,
        own_cpu: OwnCpu,
    ) -> None:
        self.connection = Connection(
            clock, server, link, seed, on_up=self._start_beating, on_lost=self._fail_all
        )
        self._clock = clock
        self._server = server
        self._robot = robot
        self._truth = truth
        self._pending: dict[int, _Pending] = {}
        self._heartbeat = Heartbeat(heartbeat_s, seed, own_cpu)
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
                self._say_beat()
            self._clock.after(self.sending_s, partial(self._send, pending))
            self._clock.at(pending.deadline_s, partial(self._expire, pending))
        return pending.future

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
        """Seconds that packing a request takes now, or unpacking a reply."""
        return self._truth.cost.sending_s / 2 / self._robot.share_of_one_more

    def _send(self, pending: _Pending) -> None:
        if not self._waits(pending):
            return
        size = self._truth.asked(pending.number).bytes_out
        pending.bytes_out += size
        budget_s = pending.deadline_s - self._clock.now_s()
        cpu_s = self._truth.cpu_s(CLOUD, pending.call)
        answer = partial(self._answer, pending)
        request = partial(self._server.request, self._key(pending), cpu_s, budget_s, answer)
        self.connection.say(size, f"{TASK}{pending.attempt}", pending.number, request)

    def _answer(self, pending: _Pending, reply: Reply) -> None:
        """The server says this."""
        size = MISSING_BYTES
        if reply.status not in (BUSY, NEED_BLOB):
            size = self._truth.asked(pending.number).bytes_in
        what = f"{TASK}{pending.attempt}"
        self.connection.answer(size, what, pending.number, partial(self._hear, pending, reply, size))

    def _hear(self, pending: _Pending, reply: Reply, size: int) -> None:
        """The robot receives it."""
        self._heartbeat.hear(self._clock.now_s(), reply.told)
        self._clock.after(self.sending_s, partial(self._take, pending, reply, size))

    def _take(self, pending: _Pending, reply: Reply, size: int) -> None:
        if not self._waits(pending):
            return
        if reply.status == NEED_BLOB:
            blob_bytes = self._truth.blob_bytes
            self.connection.say(blob_bytes, BLOB, pending.number, self._server.take_blob)
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
                CLOUD,
                seconds,
                self._truth.value(pending.call),
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
        """Nobody waits for the answer any more."""
        cancel = partial(self._server.cancel, self._key(pending))
        self.connection.say(CANCEL_BYTES, CANCEL, pending.number, cancel)
        self._end(pending, failure, censored=True)
        self._hurry()

    def _hurry(self) -> None:
        self._heartbeat.hurry(self._clock.now_s())
        self._plan_beat()

    def _plan_beat(self) -> None:
        self._clock.at(self._heartbeat.due_s, partial(self._beat, self._heartbeat.due_s))

    def _end(
        self, pending: _Pending, failure: OffloadError, *, censored: bool = False, started: bool = True
    ) -> None:
        self._pending.pop(pending.call.id, None)
        seconds = self._clock.now_s() - pending.published_s
        pending.future.set_result(
            Execution(
                CLOUD,
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

    def _beat(self, due_s: float) -> None:
        if self._heartbeat.due_s == due_s:  # else it was sent with a task, or another connection beats by now
            self._say_beat()

    def _say_beat(self) -> None:
        number = self._heartbeat.beat(self._clock.now_s())
        self.connection.say(BEAT_BYTES, BEAT, number, partial(self._beat_back, number))
        self._plan_beat()

    def _beat_back(self, number: int) -> None:
        told = self._server.told
        self.connection.answer(BEAT_REPLY_BYTES, BEAT, number, partial(self._beat_heard, number, told))

    def _beat_heard(self, number: int, told: ServerReport) -> None:
        self._heartbeat.answer(number, self._clock.now_s(), told)
        self._plan_beat()
