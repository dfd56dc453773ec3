"""The robot's `Offloader` for a caller that waits itself, so that many calls at once need no thread."""

from collections.abc import Callable, Generator
from typing import Any

from offboard.common.tasks import Task, kind_of
from offboard.robot_client.execution.batch import Placed
from offboard.robot_client.execution.race import Wait
from offboard.robot_client.learning.learner import PendingTask
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.records.record import Record
from offboard.robot_client.sites.outgoing import new_task


class SteppedOffloader(Offloader):
    """Predicts, decides, executes, learns and records as every offloader; `clock` only tells the time.

    `deadline_s`: of the next calls. They are decided for a deadline, but never raise DeadlineMissed.
    """

    deadline_s: float | None = None

    def steps(
        self, function: Callable[..., Any], *args: Any, timeout_s: float | None = None
    ) -> Generator[Wait, None, Record]:
        """The same as a call: yields each wait, and goes on when it is over. It does not raise a failure."""
        kind = kind_of(function)
        pending = self._begin(new_task(kind, kind.bind(args, {})), None, timeout_s or self._timeout_s)
        race, plan = self._runs.race(pending)
        executions = yield from race.steps(plan)
        return self._end(pending, executions)[1]

    def _begin(
        self,
        task: Task,
        where: str | None,
        budget_s: float,
        *,
        placed: Placed | None = None,
        deadline_s: float | None = None,
    ) -> PendingTask:
        within_s = self.deadline_s if deadline_s is None else deadline_s
        return super()._begin(task, where, budget_s, placed=placed, deadline_s=within_s)
