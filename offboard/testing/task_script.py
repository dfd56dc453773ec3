"""What a scripted site does with each task: how long it takes, and what the function returns or raises."""

from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

from offboard.common.errors import OffloadError, TaskFailed, describe, is_interrupt, of_task
from offboard.common.task_call import call_while, traceback_of
from offboard.common.task_states import TaskStates
from offboard.common.tasks import Kind, Task
from offboard.robot_client.sites.runner import Execution

Seconds = float | Callable[..., float]
Result = tuple[Any, OffloadError | None]


class TaskScript:
    """How long each task takes on a site, and what its function returns there."""

    def __init__(self, seconds: Seconds) -> None:
        self._usual = self._seconds = seconds
        self._states = TaskStates(1)

    def slow(self, seconds: Seconds) -> None:
        """Tasks that begin from now on take this many seconds; a function gets their arguments."""
        self._seconds = seconds

    def back(self) -> None:
        """From now on, the site is as it was at first."""
        self._seconds = self._usual

    def _takes_s(self, task: Task) -> float:
        return self._seconds(*task.args) if callable(self._seconds) else self._seconds

    def _call(self, task: Task, kind: Kind, args: tuple[Any, ...], future: "Future[Execution]") -> Result:
        """What the function of this site returns, or the failure that its caller gets."""
        try:
            with self._states.lend(kind) as state:
                return _called(task, kind.function, (*state, *args), lambda: not future.done())
        except TaskFailed as failure:  # of the setup
            return None, failure


def _called(
    task: Task, function: Callable[..., Any], args: tuple[Any, ...], wanted: Callable[[], bool]
) -> Result:
    try:
        return call_while(wanted, function, args), None
    except BaseException as error:  # whatever the function raises is the task's failure
        if is_interrupt(error):
            raise
        failure = TaskFailed(of_task(task.kind.name, describe(error)), traceback_of(error))
        failure.__cause__ = error
        return None, failure
