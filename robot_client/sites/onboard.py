"""The runner of the robot's own computer: it runs tasks in threads of this process."""

import contextlib
import logging
import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future
from contextvars import ContextVar
from dataclasses import dataclass
from functools import partial
from queue import SimpleQueue
from typing import Any

from offboard.common import cpu_time
from offboard.common.cpu_time import SELF
from offboard.common.errors import (
    OffloadError,
    Overtaken,
    TaskFailed,
    Unwanted,
    describe,
    is_interrupt,
    of_task,
)
from offboard.common.load import LOADED, Load, LoadWatch
from offboard.common.task_call import call_while, join_all, traceback_of
from offboard.common.task_states import TaskStates
from offboard.common.tasks import Kind, Task
from offboard.robot_client.sites.heartbeat import Background
from offboard.robot_client.sites.runner import NOTHING, ONBOARD, Condition, Execution, Sending

ABANDONED_MAX = 4  # cancelled runs that go on at the same time
ABANDONED_NICE = 10  # their niceness: a tenth of the CPU time of a task with niceness 0 (sched(7))
# For the runs that go on when the runner is closed: a task takes a second or two, an abandoned one longer, at
# its low priority. A longer wait would only delay the end of a robot whose task hangs.
CLOSE_WAIT_S = 5.0

log = logging.getLogger(__name__)

_inside: ContextVar[bool] = ContextVar("inside", default=False)


def inside_a_task() -> bool:
    """Whether the caller is the code of a task that runs onboard."""
    return _inside.get()


@contextlib.contextmanager
def _as_a_task() -> Iterator[None]:
    token = _inside.set(True)
    try:
        yield
    finally:
        _inside.reset(token)


@dataclass(eq=False, slots=True)
class _Run:
    """One run of a task.

    thread: native id of the thread that runs it; None while it waits in the queue.
    wanted: false once it was cancelled.
    abandoned: it was cancelled while it ran, and goes on without a place among the workers.
    """

    task: Task
    published_s: float
    future: "OnboardAnswer"
    thread: int | None = None
    wanted: bool = True
    abandoned: bool = False


class OnboardAnswer(Future[Execution]):
    """The future of a run, which knows how much of the time so far went into setups."""

    def __init__(self, states: TaskStates, published_s: float) -> None:
        super().__init__()
        self._states = states
        self._published_s = published_s

    def setup_s(self) -> float:
        return self._states.setup_s(self._published_s, time.perf_counter())


class OnboardRunner:
    """Runs at most `workers` tasks at a time. The seconds of a task include its wait in the queue.

    A task that is submitted by the code of a task runs in the thread of its caller: the queue might wait for
    that caller. The same holds if the system has no thread for the first worker.

    Python cannot stop a thread. So a run that is cancelled is abandoned: it goes on at a low priority until
    it ends or calls `check_wanted`, and a new thread takes its place. But a kind with a setup has one state
    per worker, so its run keeps state and place, and the next task waits until it ends.

    A setup runs when its kind first runs here, or in `prepare`. No time of a task includes it. Runners that
    share `states` run it once: a run waits while another runner uses the state.
    """

    site = ONBOARD

    def __init__(
        self, workers: int = 1, *, states: TaskStates | None = None, background: Background | None = None
    ) -> None:
        self._workers = workers
        self._queue: SimpleQueue[_Run | None] = SimpleQueue()
        self._runs: dict[int, _Run] = {}  # those that have not ended, by task id
        self._threads = 0  # without those of abandoned runs
        self._started: list[threading.Thread] = []  # all that have not ended, and a few that have
        self._abandoned = 0
        self._states = states or TaskStates(workers)
        self._preparing: dict[str, Future[None]] = {}  # by kind
        self._closed = False
        self._lock = threading.Lock()
        self._background = background or Background()
        self._load = LoadWatch(Load(SELF), pause_s=self._background.pause_s)
        self._condition = Condition()

    def unavailable(self, kind: Kind) -> str | None:  # noqa: ARG002 - onboard always exists
        return None

    def submit(self, task: Task, budget_s: float) -> "Future[Execution]":  # noqa: ARG002 - a thread cannot be stopped
        published_s = time.perf_counter()
        run = _Run(task, published_s, OnboardAnswer(self._states, published_s))
        with self._lock:
            if self._closed:
                raise OffloadError("the onboard runner is closed")
            queued = not inside_a_task() and self._has_worker()
            if queued:
                self._runs[task.id] = run
                self._queue.put(run)
        if not queued:
            self._run_here(run)
        return run.future

    def to_send(self, task: Task) -> Sending:  # noqa: ARG002 - nothing is sent
        return NOTHING

    def cancel(self, task: Task) -> None:
        """Remove the task from the queue, or let its run stop early.

        Past ABANDONED_MAX, and if no thread can be started, the run keeps its place until it ends.
        """
        with self._lock:
            run = self._runs.get(task.id)
            if run is None or not run.wanted:
                return
            if run.thread is None:
                del self._runs[task.id]
            else:
                run.wanted = False
                keeps = task.kind.setup is not None or self._abandoned == ABANDONED_MAX
                if keeps or not self._start(self._work):
                    return
                self._abandon(run)
        run.future.set_result(_overtaken(run, started=run.thread is not None))

    def prepare(self, kind: Kind) -> "Future[None]":
        """Begin the setup of a kind in each worker, unless it was made. The future may hold TaskFailed."""
        kind = kind.at(ONBOARD)
        with self._lock:
            known = self._preparing.get(kind.name)
            if known is not None and (not known.done() or known.exception() is None):
                return known
            prepared = self._preparing[kind.name] = Future[None]()
            if self._closed or self._states.ready(kind):
                prepared.set_result(None)
                return prepared
            prepare = partial(self._prepare, kind, prepared)
            started = self._start(prepare)
        if not started:
            prepare()
        return prepared

    def hurry(self) -> None:
        self._load.hurry()

    def condition(self) -> Condition:
        found, (load, capacity) = self._condition, self._load.latest()
        self._background.loaded = load > LOADED
        if found.load != load or found.capacity != capacity:
            found = self._condition = Condition(load=load, capacity=capacity)
        return found

    def close(self) -> None:
        """Cancel the tasks in the queue, and wait for those that run, for at most CLOSE_WAIT_S.

        A run that goes on after that is given up, so that the process can end although a call waits for it.
        """
        with self._lock:
            if self._closed:
                return
            self._closed = True
            self._load.close()
            waiting = [run for run in self._runs.values() if run.thread is None]
            for run in waiting:
                del self._runs[run.task.id]
            for _ in range(self._threads):
                self._queue.put(None)
        _give_up(waiting)
        if count := join_all(self._started, CLOSE_WAIT_S):
            text = "%s: %d of its threads still run a task %g s after the close; if that is native code, "
            text += "it may crash when the process ends; remedy: end calls before the close"
            log.warning(text, ONBOARD, count, CLOSE_WAIT_S)
        with self._lock:
            running = [run for run in self._runs.values() if not run.abandoned]
            for run in running:
                self._abandon(run)
        _give_up(running)

    def _has_worker(self) -> bool:
        """Whether a worker will take the next task. Starts one if all others have a task already."""
        waiting = len(self._runs) - self._abandoned
        if self._threads < min(self._workers, waiting + 1) and self._start(self._work):
            self._threads += 1
        return self._threads > 0

    def _start(self, target: Callable[[], None]) -> bool:
        """Start a thread. False if the system has none left at this moment."""
        thread = threading.Thread(target=target, name=ONBOARD, daemon=True)
        try:
            thread.start()
        except RuntimeError:
            return False
        self._started = [*(other for other in self._started if other.is_alive()), thread]
        return True

    def _abandon(self, run: _Run) -> None:
        assert run.thread is not None
        run.wanted, run.abandoned = False, True
        self._abandoned += 1
        with contextlib.suppress(OSError, AttributeError):  # on systems without priorities for threads
            os.setpriority(os.PRIO_PROCESS, run.thread, ABANDONED_NICE)

    def _prepare(self, kind: Kind, prepared: "Future[None]") -> None:
        try:
            with _as_a_task():  # its setup may call a task
                self._states.prepare(kind)
        except TaskFailed as failure:
            prepared.set_exception(failure)
        else:
            prepared.set_result(None)

    def _work(self) -> None:
        """Run tasks until a run is abandoned or the runner is closed. Each thread does this."""
        _inside.set(True)
        while (run := self._queue.get()) is not None and self._work_on(run):
            del run  # an idle thread must not keep arguments, result and offloader alive

    def _work_on(self, run: _Run) -> bool:
        """Run a task. False if its run was abandoned, so that another thread has the place of this one."""
        with self._lock:
            if self._runs.get(run.task.id) is not run:  # cancelled, or closed
                return True
            run.thread = threading.get_native_id()
            self._background.begin()
        execution = _run(run, self._states)
        with self._lock:
            self._background.end()
            del self._runs[run.task.id]
            if run.abandoned:
                self._abandoned -= 1
                return False
        run.future.set_result(execution)
        return True

    def _run_here(self, run: _Run) -> None:
        """Run a task in the thread of its caller."""
        with _as_a_task():
            run.future.set_result(_run(run, self._states))


def _give_up(runs: Iterable[_Run]) -> None:
    for run in runs:
        run.future.cancel()
        run.future.set_running_or_notify_cancel()  # or a wait for several futures would go on


def _run(run: _Run, states: TaskStates) -> Execution:
    try:
        with states.lend(run.task.kind.at(ONBOARD)) as state:
            if not run.wanted:  # cancelled during the setup
                return _overtaken(run, started=False)
            return _call(run, state, states)
    except TaskFailed as failure:  # of the setup
        seconds = time.perf_counter() - run.published_s - run.future.setup_s()
        return Execution(ONBOARD, seconds, failure=failure, queue_s=seconds, network_s=0.0, started=False)


def _call(run: _Run, state: tuple[Any, ...], states: TaskStates) -> Execution:
    cpu_before_s, started_s = cpu_time.used_s(), time.perf_counter()
    value, failure = None, None
    try:
        function = run.task.kind.at(ONBOARD).function
        value = call_while(lambda: run.wanted, function, (*state, *run.task.args))
    except BaseException as error:  # anything else that the function raises is the task's failure
        if is_interrupt(error):
            raise
        failure = TaskFailed(of_task(run.task.kind.name, describe(error)), traceback_of(error))
        failure.__cause__ = error
        if isinstance(error, Unwanted) and not run.wanted:
            return _overtaken(run, started=True)
    cpu_s = cpu_time.used_s() - cpu_before_s
    # Reading the CPU time makes the kernel charge this thread. A thread that has used more than its quota is
    # then stopped for a while, and the caller waits for that too.
    ended_s = time.perf_counter()
    setup_s = states.setup_s(run.published_s, started_s)
    return Execution(
        ONBOARD,
        ended_s - run.published_s - setup_s,
        value,
        failure,
        queue_s=started_s - run.published_s - setup_s,
        run_s=ended_s - started_s,
        network_s=0.0,
        cpu_s=cpu_s,
    )


def _overtaken(run: _Run, *, started: bool) -> Execution:
    seconds = time.perf_counter() - run.published_s - run.future.setup_s()
    failure = Overtaken("its answer is no longer needed")
    return Execution(ONBOARD, seconds, failure=failure, censored=True, started=started)
