"""What the tasks of a simulated robot truly cost, and the calls that stand for them.

A call holds the size and the number of its task; that is all that the sites of a simulation need to know.
"""

from collections.abc import Callable
from typing import Any

from offboard.common.tasks import Task, task
from offboard.loadgen.simulation.model.costs import Noise
from offboard.loadgen.simulation.model.simulated_tasks import Asked, Tasks
from offboard.robot_client.sites.runner import ONBOARD


class Truth:
    """Of one robot's tasks, which begin again after the last."""

    def __init__(self, tasks: Tasks, noise: Noise) -> None:
        self.cost, self.blob_bytes = tasks.cost, tasks.blob_bytes
        self.function: Callable[..., Any] = _telling if tasks.told else _untold
        self._tasks = tasks.asked
        self._noise = noise

    def asked(self, number: int) -> Asked:
        return self._tasks[number % len(self._tasks)]

    def seconds(self, site: str, number: int) -> float:
        """CPU seconds of a task at a whole CPU of this site."""
        return self.cost.cpu_s(self.asked(number).work[site]) * self._noise.factor(site, number)

    def cpu_s(self, site: str, call: Task) -> float:
        return self.seconds(site, number_of(call))

    def value(self, call: Task) -> float:
        """The answer that the call gets: the work that it was, where that is told the same on every site."""
        return self.asked(number_of(call)).work[ONBOARD]


def number_of(call: Task) -> int:
    """Of the task that a call stands for."""
    _size, number = call.args
    return int(number)


@task("simulated_telling", size=lambda size, number: size, work=float)  # noqa: ARG005 - the size is known
def _telling(size: float, number: int) -> float:  # noqa: ARG001
    """A task whose result tells its work."""
    raise AssertionError("a simulated task is never run")


@task("simulated_untold", size=lambda size, number: size)  # noqa: ARG005 - the size is known
def _untold(size: float, number: int) -> float:  # noqa: ARG001
    """A task that nothing tells the work of."""
    raise AssertionError("a simulated task is never run")
