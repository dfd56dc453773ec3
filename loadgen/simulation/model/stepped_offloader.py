"""Several callers of an `Offloader` in virtual time without threads.

Each caller is a generator that yields what it waits for.
"""

from collections.abc import Callable, Collection, Generator
from concurrent.futures import Future
from functools import partial
from typing import Any

from offboard.common.tasks import Task, kind_of
from offboard.robot_client.calls import Options
from offboard.robot_client.execution.batch import Placed
from offboard.robot_client.execution.call_future import CallFuture
from offboard.robot_client.execution.race import Wait
from offboard.robot_client.learning.learner import PendingTask
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.records.record import Record
from offboard.robot_client.sites.outgoing import new_task
from offboard.testing.virtual_clock import VirtualClock

Walk = Generator[Wait, None, None]


class SteppedOffloader(Offloader):
    """Predicts, decides, executes, learns and records as every offloader; `clock` only tells the time.

    `deadline_s`: of the next calls. They are decided for a deadline, but never raise DeadlineMissed.
    """

    deadline_s: float | None = None
    steps_itself = True
    _clock: VirtualClock

    def _submit(
        self,
        function: Callable[..., Any],
        args: tuple[Any, ...],
        kwargs: dict[str, Any],
        *,
        options: Options,
        future: CallFuture[Any],
    ) -> CallFuture[Any]:
        """The call of a future, which goes on while others wait."""
        kind = kind_of(function)
        task = new_task(kind, kind.bind(args, kwargs))
        Walker(self._clock, self._answered(task, options, future)).begin()
        return future

    def _answered(self, task: Task, options: Options, future: CallFuture[Any]) -> Walk:
        where, timeout_s, _ = options
        pending = self._begin(task, where, timeout_s or self._timeout_s, caller=future)
        race, plan = self._runs.race(pending)
        answer, _ = self._end(pending, (yield from race.steps(plan)))
        if answer.failure is None:
            future.set_result(answer.value)
        else:
            future.set_exception(answer.failure)

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
        caller: CallFuture[Any] | None = None,
    ) -> PendingTask:
        within_s = self.deadline_s if deadline_s is None else deadline_s
        return super()._begin(task, where, budget_s, placed=placed, deadline_s=within_s, caller=caller)


class Walker:
    """Moves one generator on: it runs until it waits, and goes on after the event that ends the wait.

    An exception of the generator is raised where the clock makes that event happen.
    """

    def __init__(self, clock: VirtualClock, walk: Walk) -> None:
        self._clock = clock
        self._walk = walk
        self._turn = 0  # of the wait that goes on; what belongs to an earlier one wakes nobody

    def begin(self) -> None:
        self._go_on(self._turn)

    def _go_on(self, turn: int) -> None:
        if turn != self._turn:
            return
        self._turn += 1
        try:
            pending, timeout_s = next(self._walk)
            while any(one.done() for one in pending):
                pending, timeout_s = next(self._walk)
        except StopIteration:
            return
        self._wait(pending, timeout_s, partial(self._go_on, self._turn))

    def _wait(
        self, pending: "Collection[Future[Any]]", timeout_s: float | None, go_on: "partial[None]"
    ) -> None:
        for one in pending:
            one.add_done_callback(lambda _: self._clock.at(self._clock.now_s(), go_on))
        if timeout_s is not None:
            self._clock.after(max(0.0, timeout_s), go_on)
