"""The runner of the robot's own computer."""

import contextlib
import os
import threading
import time
from concurrent.futures import Future
from dataclasses import dataclass, field
from queue import SimpleQueue

from offboard.common.errors import OffloadError, Overtaken, TaskFailed, describe
from offboard.common.host import cpu_time
from offboard.common.host.cgroup import SELF
from offboard.common.host.load import LOADED, Load
from offboard.common.host.load_watch import LoadWatch
from offboard.common.tasks import Kind, Task
from offboard.common.threads import join_all
from offboard.common.wanted import call_while
from offboard.robot_client.sites.own_cpu import OWN_CPU
from offboard.robot_client.sites.runner import ONBOARD, Condition, Execution

ASIDE_MAX = 4  # runs that nobody waits for any more and that still go on
ASIDE_NICE = 10  # theirs: beside a task of nice 0 a tenth of its CPU time (sched(7))
CLOSE_WAIT_S = 1.0  # for what runs at the end


@dataclass(eq=False, slots=True)
class _Run:
    """A task in line, or running in the thread of this native id; `aside`: nobody waits for it any more."""

    task: Task
    published: float
    future: "Future[Execution]" = field(default_factory=Future)
    thread: int | None = None
    aside: bool = False


class OnboardRunner:
    """Runs tasks in this process, `workers` at a time; a waiting task's seconds include its wait.

    A thread cannot be stopped: another one takes the place of a run that is cancelled, which goes on aside,
    at a low priority, until it ends or looks whether it is wanted.
    """

    site = ONBOARD

    def __init__(self, workers: int = 1) -> None:
        self._workers = workers
        self._line: SimpleQueue[_Run | None] = SimpleQueue()
        self._runs: dict[int, _Run] = {}  # that have not ended
        self._threads = 0  # without those aside
        self._started: list[threading.Thread] = []  # all of them, but for some that have ended
        self._aside = 0
        self._closed = False
        self._lock = threading.Lock()
        self._load = LoadWatch(Load(SELF), pause_s=OWN_CPU.pause_s)
        self._condition = Condition()

    def unavailable(self, kind: Kind) -> str | None:  # noqa: ARG002 - onboard always exists
        return None

    def submit(self, task: Task, budget_s: float) -> "Future[Execution]":  # noqa: ARG002 - a thread cannot be stopped
        run = _Run(task, time.perf_counter())
        with self._lock:
            if self._closed:
                raise OffloadError("the onboard runner is closed")
            self._runs[task.id] = run
            if self._threads < min(self._workers, len(self._runs) - self._aside):
                self._start_thread()
            self._line.put(run)
        return run.future

    def cancel(self, task: Task) -> None:
        """One that waits is not begun; one that runs goes on aside, ASIDE_MAX of them at most."""
        with self._lock:
            run = self._runs.get(task.id)
            if run is None or run.aside or (run.thread is not None and self._aside == ASIDE_MAX):
                return
            if run.thread is None:
                del self._runs[task.id]
            else:
                self._put_aside(run, run.thread)
        failure = Overtaken("another site answered first")
        seconds, started = time.perf_counter() - run.published, run.thread is not None
        run.future.set_result(Execution(ONBOARD, seconds, failure=failure, censored=True, started=started))

    def hurry(self) -> None:
        self._load.hurry()

    def condition(self) -> Condition:
        found, (load, capacity) = self._condition, self._load.latest()
        OWN_CPU.loaded = load > LOADED
        if found.load != load or found.capacity != capacity:
            found = self._condition = Condition(load=load, capacity=capacity)
        return found

    def close(self) -> None:
        """What runs is waited for, for CLOSE_WAIT_S at most."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            self._load.close()
            OWN_CPU.loaded = False  # nobody reads it any more
            waiting = [run for run in self._runs.values() if run.thread is None]
            for run in waiting:
                del self._runs[run.task.id]
            for _ in range(self._threads):
                self._line.put(None)
        for run in waiting:
            run.future.cancel()
        join_all(self._started, CLOSE_WAIT_S)

    def _start_thread(self) -> None:
        self._threads += 1
        thread = threading.Thread(target=self._work, name=ONBOARD, daemon=True)
        thread.start()
        self._started = [*(one for one in self._started if one.is_alive()), thread]

    def _put_aside(self, run: _Run, thread: int) -> None:
        run.aside = True
        self._aside += 1
        with contextlib.suppress(OSError, AttributeError):  # where threads have no priority of their own
            os.setpriority(os.PRIO_PROCESS, thread, ASIDE_NICE)
        self._threads -= 1
        self._start_thread()

    def _work(self) -> None:
        """What a thread does until it is put aside or the runner is closed."""
        while (run := self._line.get()) is not None:
            with self._lock:
                if self._runs.get(run.task.id) is not run:  # cancelled, or closed
                    continue
                run.thread = threading.get_native_id()
            execution = _run(run)
            with self._lock:
                del self._runs[run.task.id]
                if run.aside:
                    self._aside -= 1
                    return
            run.future.set_result(execution)


def _run(run: _Run) -> Execution:
    cpu_before_s, started = cpu_time.used_s(), time.perf_counter()
    value, failure = None, None
    OWN_CPU.begin()
    try:
        value = call_while(lambda: not run.aside, run.task.kind.function, run.task.args)
    except BaseException as error:  # noqa: BLE001 - whatever a user's function raises is the task's failure
        failure = TaskFailed(describe(error))
        failure.__cause__ = error
    cpu_s = cpu_time.used_s() - cpu_before_s
    # Asked for its CPU time the kernel charges this thread, and under a quota stops it until what it overdrew
    # is paid: the caller waits for that too.
    now = time.perf_counter()
    OWN_CPU.end(now)
    return Execution(
        ONBOARD,
        now - run.published,
        value,
        failure,
        queue_s=started - run.published,
        run_s=now - started,
        network_s=0.0,
        cpu_s=cpu_s,
    )
