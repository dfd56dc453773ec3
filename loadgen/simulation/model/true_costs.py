"""What the tasks of a simulated robot really cost, and the calls that stand for them.

A call holds only the size and the number of its task; the sites of a simulation need no more.
"""

from collections.abc import Callable
from typing import Any

from offboard.common.tasks import Task, task
from offboard.loadgen.simulation.model.simulated_tasks import RobotTasks, SimulatedTask
from offboard.loadgen.simulation.model.task_costs import Noise
from offboard.robot_client.sites.runner import ONBOARD


class TrueCosts:
    """The costs of the tasks of one robot, which starts again with the first task after the last one."""

    def __init__(self, tasks: RobotTasks, noise: Noise) -> None:
        self.cost, self.blob_bytes = tasks.cost, tasks.blob_bytes
        self.function: Callable[..., Any] = _reports_work if tasks.reports_work else _reports_no_work
        self._tasks = tasks.tasks
        self._noise = noise

    def task(self, number: int) -> SimulatedTask:
        return self._tasks[number % len(self._tasks)]

    def seconds(self, site: str, number: int) -> float:
        """CPU seconds of a task on a full CPU of this site."""
        return self.cost.cpu_s(self.task(number).work[site]) * self._noise.factor(site, number)

    def cpu_s(self, site: str, call: Task) -> float:
        return self.seconds(site, number_of(call))

    def value(self, call: Task) -> float:
        """The answer of a call: its work, which is the same on every site where answers report it."""
        return self.task(number_of(call)).work[ONBOARD]


def number_of(call: Task) -> int:
    """The number of the task that a call stands for."""
    _size, number = call.args
    return int(number)


@task("simulated_with_work", size=lambda size, number: size, work=float)  # noqa: ARG005 - the size is known
def _reports_work(size: float, number: int) -> float:  # noqa: ARG001
    """A task whose answer reports its work."""
    raise AssertionError("a simulated task is never run")


@task("simulated_without_work", size=lambda size, number: size)  # noqa: ARG005 - the size is known
def _reports_no_work(size: float, number: int) -> float:  # noqa: ARG001
    """A task whose answer does not report its work."""
    raise AssertionError("a simulated task is never run")
