"""The simulated runner of a server's site: its requests and replies travel over a modelled link."""

from functools import partial

from offboard.common.errors import CloudBusy
from offboard.common.tasks import Task
from offboard.loadgen.relay.link.link import Link
from offboard.loadgen.simulation.model.simulated_connection import TASK, Message, SimulatedConnection
from offboard.loadgen.simulation.model.simulated_cpu import SimulatedCpu
from offboard.loadgen.simulation.model.simulated_server import BUSY, NEED_BLOB, Reply, SimulatedServer
from offboard.loadgen.simulation.model.task_costs import (
    BEAT_BYTES,
    BEAT_REPLY_BYTES,
    CANCEL_BYTES,
    MISSING_BYTES,
)
from offboard.loadgen.simulation.model.true_costs import TrueCosts, number_of
from offboard.loadgen.simulation.virtual_site import VirtualSite
from offboard.loadgen.testbed.testbed import ROBOT
from offboard.robot_client.sites.conversation import PendingRequest
from offboard.robot_client.sites.heartbeat import Heartbeat
from offboard.robot_client.sites.runner import CLOUD
from offboard.testing.virtual_clock import VirtualClock

BEAT, CANCEL, BLOB = "beat", "cancel", "blob"  # sorts of messages


class SimulatedCloud(VirtualSite):
    """A server, as the first robot uses it, with `heartbeat_s` between heartbeats; 0 means none."""

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
        self.connection = SimulatedConnection(clock, server, link, seed, on_up=self._up, on_lost=self._down)
        self._server = server
        super().__init__(clock, cpu, costs, site=site, heartbeat=Heartbeat(heartbeat_s, seed))

    def _send_packed(self, request: PendingRequest, attempt: int = 1) -> None:
        number = number_of(request.task)
        size = self._costs.task(number).bytes_out
        request.bytes_out += size
        received = partial(
            self._server.request,
            (ROBOT, request.task.id),
            cpu_s=self._costs.cpu_s(CLOUD, request.task),
            budget_s=request.deadline_s - self._clock.now_s(),
            answer=partial(self._reply, request, attempt),
        )
        self.connection.send(Message(size, f"{TASK}{attempt}", number), received)

    def _reply(self, request: PendingRequest, attempt: int, reply: Reply) -> None:
        """The server sends a reply."""
        message = Message(self._bytes_in(request, reply), f"{TASK}{attempt}", number_of(request.task))
        self.connection.to_robot.send(message, partial(self._receive, request, attempt, reply))

    def _bytes_in(self, request: PendingRequest, reply: Reply) -> int:
        if reply.status in (BUSY, NEED_BLOB):
            return MISSING_BYTES
        return self._costs.task(number_of(request.task)).bytes_in

    def _receive(self, request: PendingRequest, attempt: int, reply: Reply) -> None:
        """The reply arrives at the robot."""
        self.conversation.heard(self._clock.now_s(), reply.told)
        self._clock.after(self.sending_s, partial(self._take, request, attempt, reply))

    def _take(self, request: PendingRequest, attempt: int, reply: Reply) -> None:
        """The robot has unpacked the reply."""
        if self.conversation.asked(request.task.id) is not request:
            return
        if reply.status == NEED_BLOB:
            blob_bytes = self._costs.blob_bytes
            self.connection.send(Message(blob_bytes, BLOB, number_of(request.task)), self._server.take_blob)
            request.bytes_out += blob_bytes
            self._send_packed(request, attempt + 1)
        elif reply.status == BUSY:
            busy = CloudBusy(f"{reply.told.queue} requests are waiting")
            self._event(lambda now_s: [self.conversation.fail(request, busy, now_s, started=False)])
        else:
            self._unpacked(
                request,
                queue_s=reply.queue_s,
                run_s=reply.run_s,
                cpu_s=reply.cpu_s,
                bytes_in=self._bytes_in(request, reply),
            )

    def _cancel(self, task: Task) -> None:
        cancel = partial(self._server.cancel, (ROBOT, task.id))
        self.connection.send(Message(CANCEL_BYTES, CANCEL, number_of(task)), cancel)

    def _beat(self, number: int) -> None:
        reply = partial(self._reply_to_beat, number)
        self.connection.send(Message(BEAT_BYTES, BEAT, number), reply)

    def _reply_to_beat(self, number: int) -> None:
        arrive = partial(self._pong, number, self._server.told)
        self.connection.to_robot.send(Message(BEAT_REPLY_BYTES, BEAT, number), arrive)
