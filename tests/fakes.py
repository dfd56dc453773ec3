"""A runner that answers from a script, for tests of deciding and learning."""

from collections.abc import Callable
from concurrent.futures import Future

from offboard.common.tasks import Kind, Task
from offboard.robot_client.sites.runner import UNMEASURED, Condition, Execution, Sending


class ScriptedRunner:
    """Answers each task at once with what `script` returns, and keeps the tasks."""

    def __init__(
        self, site: str, script: Callable[[Task], Execution], unavailable: str | None = None
    ) -> None:
        self.site = site
        self.script = script
        self.absent = unavailable
        self.tasks: list[Task] = []
        self.closed = False
        self.cancelled: list[Task] = []
        self.measured = UNMEASURED
        self.hurried = 0
        self.bytes_out = 0  # that a task would send

    def unavailable(self, kind: Kind) -> str | None:  # noqa: ARG002 - the same for every kind
        return self.absent

    def submit(self, task: Task, budget_s: float) -> "Future[Execution]":  # noqa: ARG002 - scripted
        self.tasks.append(task)
        future: Future[Execution] = Future()
        future.set_result(self.script(task))
        return future

    def to_send(self, task: Task) -> Sending:  # noqa: ARG002 - the same for every task
        return Sending(self.bytes_out)

    def cancel(self, task: Task) -> None:
        self.cancelled.append(task)

    def hurry(self) -> None:
        self.hurried += 1

    def condition(self) -> Condition:
        return self.measured

    def close(self) -> None:
        self.closed = True
