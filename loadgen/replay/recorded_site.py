"""A site that takes as long for each task as it took in the run, in virtual time.

What each task took is in `recorded_tasks`; which sites run it is decided by the offloader.
"""

from collections.abc import Collection
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from functools import partial

from offboard.common.errors import CloudBroken, Overtaken
from offboard.common.tasks import Kind, Task
from offboard.loadgen.replay.recorded_tasks import RecordedTask
from offboard.robot_client.sites.runner import NOTHING, ONBOARD, UNMEASURED, Condition, Execution, Sending
from offboard.testing.virtual_clock import VirtualClock

GIVEN_UP = 2.0  # times as long as the task took: when a run ends whose own end the trace does not hold


@dataclass(eq=False, slots=True)
class _Run:
    """A run under way: when it began and ends, what the trace says of it, and whether it was stopped there.

    A `lasting` one was not stopped although another site had answered.
    """

    recorded: Execution
    began_s: float
    ends_s: float
    stopped: bool
    lasting: bool
    future: "Future[Execution]" = field(default_factory=Future)


class RecordedSite:
    """The runner of one site. Onboard runs one task at a time, a server all at once."""

    def __init__(self, site: str, clock: VirtualClock) -> None:
        self.site = site
        self._clock = clock
        self._tasks: dict[int, RecordedTask] = {}  # those that have begun, by number
        self._sites: Collection[str] = ()
        self._condition = UNMEASURED
        self._runs: dict[int, _Run] = {}  # by task id

    def begin(self, number: int, task: RecordedTask) -> None:
        """The next task that is decided is this one; the second argument of its calls is `number`."""
        self._tasks[number], self._sites = task, task.sites
        self._condition = task.conditions.get(self.site, UNMEASURED)

    def unavailable(self, kind: Kind) -> str | None:  # noqa: ARG002 - one kind is replayed
        return None if self.site in self._sites else "it could not take the task in the run"

    def submit(self, task: Task, budget_s: float) -> "Future[Execution]":  # noqa: ARG002 - it ends as in the run
        of, now_s = self._recorded(task), self._clock.now_s()
        recorded = of.runs.get(self.site)
        if recorded is None:
            missing: Future[Execution] = Future()
            failure = CloudBroken("the trace does not hold this run")
            missing.set_result(Execution(self.site, 0.0, failure=failure, started=False))
            return missing
        followed = of.decision is not None  # then its seconds include the wait for other tasks
        wait_s = max([run.ends_s - now_s for run in self._runs.values()], default=0.0)
        if self.site == ONBOARD and wait_s > 0 and not followed:
            taken_s = wait_s + recorded.seconds - (recorded.queue_s or 0.0)
            recorded = replace(recorded, seconds=taken_s, queue_s=wait_s)
        stopped = isinstance(recorded.failure, Overtaken)
        seconds = GIVEN_UP * max(recorded.seconds, of.waited_s) if stopped else recorded.seconds
        lasting = followed and not stopped
        run = self._runs[task.id] = _Run(recorded, now_s, now_s + seconds, stopped=stopped, lasting=lasting)
        self._clock.at(run.ends_s, partial(self._end, task.id, run))
        return run.future

    def to_send(self, task: Task) -> Sending:
        return self._recorded(task).sendings.get(self.site, NOTHING)

    def cancel(self, task: Task) -> None:
        run = self._runs.get(task.id)
        if run is not None and not run.lasting:
            failure, seconds = Overtaken("another site answered first"), self._clock.now_s() - run.began_s
            stopped = Execution(self.site, seconds, failure=failure, censored=True)
            self._end_with(task.id, run, replace(run.recorded) if run.stopped else stopped)

    def hurry(self) -> None:
        pass

    def condition(self) -> Condition:
        return self._condition

    def close(self) -> None:
        pass

    def _recorded(self, task: Task) -> RecordedTask:
        _, number = task.args
        return self._tasks[number]

    def _end(self, task_id: int, run: _Run) -> None:
        if self._runs.get(task_id) is run:  # it was not cancelled
            self._end_with(task_id, run, replace(run.recorded))  # the robot changes what it gets

    def _end_with(self, task_id: int, run: _Run, execution: Execution) -> None:
        """A robot that gets no answer looks whether the site still answers heartbeats."""
        del self._runs[task_id]
        if not execution.ok:
            silent = run.recorded.held_up  # for as long as the run took, at least
            self._condition = self._condition._replace(
                silent=silent, wait_s=run.recorded.seconds if silent else 0.0
            )
        run.future.set_result(execution)
