"""The robot's own computer in virtual time; the functions of the tasks really run."""

import threading
from concurrent.futures import Future
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from offboard.common.errors import OffloadError, Overtaken
from offboard.common.tasks import Kind, Task
from offboard.robot_client.sites.runner import NOTHING, ONBOARD, UNMEASURED, Condition, Execution, Sending
from offboard.testing.task_script import Seconds, TaskScript
from offboard.testing.virtual_clock import VirtualClock
from offboard.testing.virtual_driver import VirtualAnswer


@dataclass(eq=False, slots=True)
class _Run:
    """One run onboard. begun_s: None while it waits for others."""

    task: Task
    published_s: float
    begun_s: float | None = None
    future: VirtualAnswer = field(default_factory=VirtualAnswer)


class ScriptedOnboard(TaskScript):
    """The robot's own computer in virtual time: one task runs at a time, for `seconds`, and others wait.

    A run that is cancelled makes room at once, unless its kind has a setup. A call that the function of a
    task makes runs next to that task.
    """

    site = ONBOARD

    def __init__(self, clock: VirtualClock, seconds: Seconds) -> None:
        super().__init__(seconds)
        self._clock = clock
        self._lock = threading.Lock()
        self._runs: list[_Run] = []
        self._closed = False
        self._calling: list[int] = []  # threads that are in the function of a task

    def unavailable(self, kind: Kind) -> str | None:  # noqa: ARG002 - onboard always exists
        return None

    def submit(self, task: Task, budget_s: float) -> "Future[Execution]":  # noqa: ARG002 - it has no limit
        run = _Run(task, self._clock.now_s())
        with self._lock:
            if self._closed:
                raise OffloadError("the onboard runner is closed")
            self._runs.append(run)
            self._begin_next(beside=threading.get_ident() in self._calling)
        return run.future

    def to_send(self, task: Task) -> Sending:  # noqa: ARG002 - nothing is sent
        return NOTHING

    def cancel(self, task: Task) -> None:
        now_s, failure = self._clock.now_s(), Overtaken("another site answered first")
        with self._lock:
            runs = [one for one in self._runs if one.task.id == task.id]
        for run in runs:
            started = run.begun_s is not None
            if not (started and task.kind.setup is not None):
                seconds = now_s - run.published_s
                self._end(run, Execution(ONBOARD, seconds, failure=failure, censored=True, started=started))

    def hurry(self) -> None:
        pass

    def condition(self) -> Condition:
        return UNMEASURED

    def close(self) -> None:
        with self._lock:
            self._closed, runs, self._runs = True, self._runs, []
        for run in runs:
            run.future.cancel()

    def _begin_next(self, *, beside: bool = False) -> None:
        """Begin the next run if none is under way, or the last one `beside` others. Called under the lock."""
        waiting = [run for run in self._runs if run.begun_s is None]
        if waiting and (beside or len(waiting) == len(self._runs)):
            run = waiting[-1 if beside else 0]
            run.begun_s = self._clock.now_s()
            self._clock.after(0.0, partial(self._run, run))

    def _run(self, run: _Run) -> None:
        if run.future.done():
            return
        me = threading.get_ident()
        self._calling.append(me)
        try:
            value, failure = self._call(run.task, run.task.kind.at(ONBOARD), run.task.args, run.future)
        finally:
            self._calling.remove(me)
        self._clock.after(self._takes_s(run.task), partial(self._ended, run, value, failure))

    def _ended(self, run: _Run, value: Any, failure: OffloadError | None) -> None:
        """A run has taken its time."""
        assert run.begun_s is not None
        now_s, begun_s = self._clock.now_s(), run.begun_s
        execution = Execution(
            ONBOARD,
            now_s - run.published_s,
            value,
            failure,
            queue_s=begun_s - run.published_s,
            run_s=now_s - begun_s,
            network_s=0.0,
            cpu_s=now_s - begun_s,
        )
        self._end(run, execution)

    def _end(self, run: _Run, execution: Execution) -> None:
        with self._lock:
            if run not in self._runs:
                return  # it was cancelled
            self._runs.remove(run)
            self._begin_next()
        run.future.set_result(execution)
