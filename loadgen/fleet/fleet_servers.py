"""The servers of a simulated fleet, what robots and they send each other, and the oracle.

All servers are equal. They live in one process, and are moved on in windows of time. Each robot has a runner
for each server that it uses, which posts messages to it. Messages are plain tuples, which other processes may
read. Every message takes the delay of the link, so nothing that is sent in one window of time arrives in it.
"""

from collections.abc import Callable, Iterable
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from offboard.common.tasks import Task
from offboard.common.variants import IN_GROUP
from offboard.loadgen.fleet.fleet_settings import FleetSize
from offboard.loadgen.simulation.model.simulated_cpu import Run, SimulatedCpu
from offboard.loadgen.simulation.model.true_costs import TrueCosts
from offboard.loadgen.simulation.virtual_site import VirtualSite
from offboard.robot_client.discovery.roster import Server
from offboard.robot_client.sites.conversation import PendingRequest
from offboard.robot_client.sites.heartbeat import Heartbeat, ServerReport
from offboard.robot_client.sites.runner import CLOUD
from offboard.testing.virtual_clock import VirtualClock

ASK, CANCEL, REQUEST, BEAT = range(4)  # what robots send; at the same instant, in this order
REPLY, BEAT_REPLY = range(2)  # what servers send

SAMPLE_S = 0.25  # between two samples of the load of every server
ROBOT = "robot"  # owns every request
GROUP = "server"

Key = tuple[int, int, int]  # server, robot, and the number of the request


class ToServer(NamedTuple):
    """A message of a robot; messages are handled in the order of their fields.

    `number` counts the tasks of the robot (ASK), its requests, or its heartbeats to this server.
    `cpu_s`: what the task takes on a server. `limit_s`: for a REQUEST, when the robot gives up; for an ASK,
    what the task would take onboard. ASK asks no server: it is how the oracle hears of a task, and of the
    servers that the robot uses (`ways`).
    """

    arrives_s: float
    sort: int
    robot: int
    server: int
    number: int
    cpu_s: float = 0.0
    limit_s: float = 0.0
    ways: tuple[int, ...] = ()


class ToRobot(NamedTuple):
    """A message of a server, with the number of what it answers, and the tasks that wait at the server."""

    arrives_s: float
    robot: int
    server: int
    sort: int
    number: int
    queue: int
    queue_s: float = 0.0
    run_s: float = 0.0


class Servers:
    """All servers, and the oracle, which knows them as they are. Each worker has a CPU of its own.

    - `delay_s`: of the link, in each direction.
    - `oracle_s`: what each task of each robot would have taken on the best site that the robot uses.
    """

    def __init__(self, size: FleetSize, tasks: int, delay_s: float) -> None:
        self.oracle_s: NDArray[np.float64] = np.full((size.robots, tasks), np.nan)
        self.samples: list[NDArray[np.int32]] = []  # requests at each server, every SAMPLE_S
        self._clock = VirtualClock()
        self._servers = [SimulatedCpu(self._clock, size.workers, size.workers) for _ in range(size.servers)]
        self._wanted: dict[Key, Run] = {}
        self._delay_s = delay_s
        self._sent: list[ToRobot] = []
        self._sample()

    @property
    def busy_s(self) -> NDArray[np.float64]:
        """What the runs of each server took so far."""
        return np.array([server.own_s for server in self._servers])

    def step(self, messages: Iterable[ToServer], until_s: float) -> list[ToRobot]:
        """Handle everything that happens up to `until_s`; returns what the servers sent."""
        for message in sorted(messages):
            self._clock.at(message.arrives_s, partial(self._receive, message))
        while self._clock.step(until_s):
            pass
        sent, self._sent = self._sent, []
        return sent

    def _sample(self) -> None:
        self.samples.append(np.array([server.count for server in self._servers], np.int32))
        self._clock.after(SAMPLE_S, self._sample)

    def _receive(self, message: ToServer) -> None:
        now_s, sort, robot, index, number, cpu_s, limit_s, ways = message
        if sort == ASK:
            begins_s = min(self._servers[one].begins_s(now_s, (), without="") for one in ways)
            self.oracle_s[robot, number] = min(limit_s, begins_s - now_s + cpu_s + 2 * self._delay_s)
            return
        server, key = self._servers[index], (index, robot, number)
        if sort == BEAT:
            self._send(key, BEAT_REPLY)
        elif sort == CANCEL:
            run = self._wanted.pop(key, None)
            if run is not None:  # one that runs goes on to its end
                server.drop(run)
        else:
            ended = partial(self._ended, key)
            self._wanted[key] = server.add(cpu_s, ended, owner=ROBOT, until_s=limit_s)

    def _ended(self, key: Key, run: Run) -> None:
        if self._wanted.pop(key, None) is not None:
            self._send(key, REPLY, queue_s=run.begun_s - run.added_s, run_s=self._clock.now_s() - run.begun_s)

    def _send(self, key: Key, sort: int, *, queue_s: float = 0.0, run_s: float = 0.0) -> None:
        index, robot, number = key
        reply = ToRobot(
            self._clock.now_s() + self._delay_s,
            robot=robot,
            server=index,
            sort=sort,
            number=number,
            queue=self._servers[index].waiting,
            queue_s=queue_s,
            run_s=run_s,
        )
        self._sent.append(reply)


class FleetSite(VirtualSite):
    """A server, as one robot of the fleet uses it. `post` sends a message, which takes `delay_s`."""

    def __init__(
        self,
        clock: VirtualClock,
        cpu: SimulatedCpu,
        costs: TrueCosts,
        *,
        site: str,
        heartbeat: Heartbeat,
        robot: int,
        delay_s: float,
        post: Callable[[ToServer], object],
    ) -> None:
        self._robot, self._server = robot, number_of(site)
        self._delay_s = delay_s
        self._post = post
        super().__init__(clock, cpu, costs, site=site, heartbeat=heartbeat)

    def receive(self, message: ToRobot) -> None:
        """A message of the server has arrived."""
        report = ServerReport(message.queue)
        if message.sort == BEAT_REPLY:
            self._pong(message.number, report)
            return
        self.conversation.heard(self._clock.now_s(), report)
        self._clock.after(self.sending_s, partial(self._take, message))

    def _take(self, message: ToRobot) -> None:
        """The robot has unpacked the answer."""
        request = self.conversation.asked(message.number)
        if request is not None:
            queue_s, run_s, bytes_in = message.queue_s, message.run_s, self._costs.task(0).bytes_in
            self._unpacked(request, queue_s=queue_s, run_s=run_s, cpu_s=run_s, bytes_in=bytes_in)

    def _send_packed(self, request: PendingRequest) -> None:
        request.bytes_out = self._costs.task(0).bytes_out  # all requests are small
        cpu_s = self._costs.cpu_s(CLOUD, request.task)
        self._message(REQUEST, request.task.id, cpu_s=cpu_s, limit_s=request.deadline_s)

    def _cancel(self, task: Task) -> None:
        self._message(CANCEL, task.id)

    def _beat(self, number: int) -> None:
        self._message(BEAT, number)

    def _message(self, sort: int, number: int, cpu_s: float = 0.0, limit_s: float = 0.0) -> None:
        arrives_s, to = self._clock.now_s() + self._delay_s, self._server
        self._post(ToServer(arrives_s, sort, self._robot, to, number=number, cpu_s=cpu_s, limit_s=limit_s))


def server_of(number: int) -> Server:
    """A server of the fleet, as robots know it: all are equal."""
    return Server(f"{GROUP}{IN_GROUP}{number}", f"simulated://{number}")


def number_of(site: str) -> int:
    return int(site.rpartition(IN_GROUP)[2])
