"""Virtual time for unit tests, and runners that work in it: the test decides what happens when."""

import math
from collections import deque
from collections.abc import Collection
from concurrent.futures import Future
from typing import Any

from offboard.common.errors import CloudTimeout, OffloadError, Overtaken, SiteClosed
from offboard.common.tasks import Kind, Task
from offboard.robot_client.sites.runner import ONBOARD, UNMEASURED, Condition, Execution, Sending
from offboard.testing import virtual_clock


class VirtualClock(virtual_clock.VirtualClock):
    """The virtual clock of the library; it remembers the timeout of each wait."""

    def __init__(self) -> None:
        super().__init__()
        self.waits: list[float | None] = []

    def wait(self, pending: "Collection[Future[Any]]", timeout_s: float | None = None) -> None:
        self.waits.append(timeout_s)
        super().wait(pending, timeout_s)

    def run_out(self) -> None:
        """Make all planned events happen."""
        while self._due:
            self.step(math.inf)


class VirtualRunner:
    """Runs each task for `takes` seconds of virtual time; None means that there is never an answer.

    As with the real runners, a run on a server is cancelled on request or at the end of its budget, and a run
    onboard continues to its end.
    """

    def __init__(self, site: str, clock: VirtualClock, takes: float | None = 0.1) -> None:
        self.site = site
        self.takes = takes
        self.failure: OffloadError | None = None
        self.fields: dict[str, Any] = {}
        self.measured = UNMEASURED
        # `takes` and `failure` of the next tasks; after them, those above count.
        self.scripts: deque[tuple[float | None, OffloadError | None]] = deque()
        self.tasks: list[Task] = []
        self.cancelled: list[Task] = []
        self.hurried_s: list[float] = []
        self.closed = False
        self._clock = clock
        self._runs: dict[int, tuple[Future[Execution], float]] = {}

    def unavailable(self, kind: Kind) -> str | None:  # noqa: ARG002
        return None

    def submit(self, task: Task, budget_s: float) -> "Future[Execution]":
        if self.closed:
            raise OffloadError(f"the runner of {self.site} is closed")
        self.tasks.append(task)
        future: Future[Execution] = Future()
        self._runs[task.id] = future, self._clock.now_s()
        takes, failure = self.scripts.popleft() if self.scripts else (self.takes, self.failure)
        if takes is not None:
            self._clock.after(takes, lambda: self._end(task, failure))
        if self.site != ONBOARD:
            self._clock.after(budget_s, lambda: self._end(task, CloudTimeout("late"), censored=True))
        return future

    def to_send(self, task: Task) -> Sending:  # noqa: ARG002 - the same for every task
        return Sending(int(self.fields.get("bytes_out", 0)))

    def cancel(self, task: Task) -> None:
        self.cancelled.append(task)
        if self.site != ONBOARD:
            self._end(task, Overtaken("another site answered first"), censored=True)

    def hurry(self) -> None:
        self.hurried_s.append(self._clock.now_s())

    def condition(self) -> Condition:
        return self.measured

    def close(self) -> None:
        self.closed = True
        for future, _ in list(self._runs.values()):
            if self.site == ONBOARD:
                future.cancel()
        if self.site == ONBOARD:
            self._runs.clear()
        for task in [task for task in self.tasks if task.id in self._runs]:
            self._end(task, SiteClosed("closed while the task was in flight"))

    def _end(self, task: Task, failure: OffloadError | None, *, censored: bool = False) -> None:
        future, began_s = self._runs.pop(task.id, (None, 0.0))
        if future is not None:
            value = None if failure else task.kind.at(self.site).function(*task.args)
            seconds = self._clock.now_s() - began_s
            future.set_result(Execution(self.site, seconds, value, failure, censored, **self.fields))
