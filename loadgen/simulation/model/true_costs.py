"""What the tasks of a simulated robot really cost: the oracle knows it, and no policy does.

A call stands for a task. It holds only size and number of the task; the sites of a simulation need no more.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from offboard.common.tasks import Task, task
from offboard.loadgen.robot.stream_policy import QUALITY
from offboard.loadgen.simulation.model.simulated_connection import TASK, Message, SimulatedConnection
from offboard.loadgen.simulation.model.simulated_cpu import SimulatedCpu
from offboard.loadgen.simulation.model.task_costs import Noise, RobotTasks, SimulatedTask
from offboard.robot_client.sites.runner import CLOUD, ONBOARD
from offboard.testing.virtual_clock import VirtualClock

Coming = tuple[float, float]  # arrival time of the request of another robot, and its CPU seconds


class TrueCosts:
    """The costs of the tasks of one robot, which starts again with the first task after the last one."""

    def __init__(self, tasks: RobotTasks, noise: Noise) -> None:
        self.cost, self.blob_bytes = tasks.cost, tasks.blob_bytes
        self.function: Callable[..., Any] = _reports_work if tasks.reports_work else _reports_no_work
        if tasks.streams:
            self.function = _follows
        self._tasks = tasks.tasks
        self._noise = noise

    def task(self, number: int) -> SimulatedTask:
        return self._tasks[number % len(self._tasks)]

    def seconds(self, site: str, number: int) -> float:
        """CPU seconds of a task on a full CPU of this site."""
        return self.cost.cpu_s(self.task(number).work[site]) * self._noise.factor(site, number)

    def cpu_s(self, site: str, call: Task) -> float:
        return self.seconds(site, number_of(call))

    def value(self, call: Task) -> Any:
        """The answer of a call: a chunk, or its work, which is the same on all sites if answers report it."""
        task = self.task(number_of(call))
        return task.work[ONBOARD] if task.answer is None else task.answer


@dataclass(frozen=True, slots=True)
class Oracle:
    """Knows what each site would really take for a task of one robot that starts now.

    `owner` is the name of the robot: its own requests at the server are left out of the queue.
    """

    clock: VirtualClock
    cpu: SimulatedCpu
    costs: TrueCosts
    owner: str

    def onboard_s(self, number: int) -> float:
        """The time onboard, if nothing else of the robot runs."""
        return self.costs.seconds(ONBOARD, number) / self.cpu.share(1)

    def cloud_s(
        self, number: int, connection: SimulatedConnection, *, coming: Iterable[Coming] = ()
    ) -> float:
        """The time on a server, if link, server and queue stay as they are now; infinite without an answer.

        `coming` are requests of other robots that are on their way to the server.
        """
        server = connection.server
        speed = server.cpu.share(1)
        if not (connection.up and server.up and speed):
            return math.inf
        task, now_s = self.costs.task(number), self.clock.now_s()
        sending_s = self.costs.cost.sending_s / 2 / self.cpu.share(1)
        request = Message(task.bytes_out, f"{TASK}1", number)
        arrives_s = connection.to_cloud.due_s(request, now_s + sending_s)
        if arrives_s == math.inf:
            return math.inf
        begins_s = server.cpu.begins_s(arrives_s, coming, without=self.owner)
        ends_s = begins_s + self.costs.seconds(CLOUD, number) / speed
        back_s = connection.to_robot.due_s(Message(task.bytes_in, f"{TASK}1", number), ends_s)
        return back_s + sending_s - now_s


def number_of(call: Task) -> int:
    """The number of the task that a call stands for."""
    _size, number = call.args
    return int(number)


@task("simulated_with_work", size=lambda size, number: size, work=float)  # noqa: ARG005 - the size is known
def _reports_work(size: float, number: int) -> float:  # noqa: ARG001
    raise AssertionError("a simulated task is never run")


@task("simulated_without_work", size=lambda size, number: size)  # noqa: ARG005 - the size is known
def _reports_no_work(size: float, number: int) -> float:  # noqa: ARG001
    raise AssertionError("a simulated task is never run")


def _follows_onboard(size: float, number: int) -> float:  # noqa: ARG001
    raise AssertionError("a simulated task is never run")


@task(
    "simulated_stream",
    size=lambda size, number: size,  # noqa: ARG005 - the size is known
    variants={ONBOARD: _follows_onboard},
    quality=QUALITY,
)
def _follows(size: float, number: int) -> float:  # noqa: ARG001
    raise AssertionError("a simulated task is never run")
