"""Where tasks run: the contract of executors, the executor that uses threads, and the list of all.

The executor that uses worker processes is in `worker_pool`.
"""

import contextlib
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from queue import Empty, SimpleQueue
from typing import Protocol

from offboard.cloud_server.task_run import Call, Outcome, run_task, warm_kinds
from offboard.cloud_server.worker_pool import WorkerPool
from offboard.common.task_states import TaskStates
from offboard.common.threads import join_all

# To wait for threads whose tasks are abandoned. This may be short: `--drain-s` was the time for those tasks,
# and if some still run, `cloud-server` ends without the teardown in which native code could crash.
CLOSE_WAIT_S = 1.0


class Executor(Protocol):
    """Runs tasks. Any thread may call `submit`, `run` and `used_s`; only the owner calls the rest."""

    workers: int

    @property
    def up(self) -> int:
        """The workers that run a task or can take one. The others are being started again."""

    def warm(self, changed: Callable[[str], None] = lambda _: None) -> "Future[None]":
        """Start all workers, and run `setup` and `warm` of each kind in them. Called once; does not wait.

        From then on `changed` is called, in any thread, with one word for the reason when a worker dies, and
        with an empty text when a worker is up again.
        """

    def submit(self, call: Call, done: "Callable[[Future[Outcome]], None]") -> "Future[Outcome]":
        """Run a task now. Only called while fewer than `up` tasks run; the future never holds an exception.

        A task may end early if it notices that it is not wanted. A worker process is killed if its task runs
        much longer than its budget. `done` is called with the future: in the thread of the worker, or in this
        thread if no worker can take the task.
        """

    def run(self, call: Call, *, meanwhile: Callable[[], None] | None) -> Outcome | None:
        """Run a task in this thread while another thread runs `meanwhile`, if that is not None.

        Returns None, and runs nothing, if this executor does not run tasks in the calling thread.
        """

    def used_s(self) -> float:
        """CPU seconds used so far by this process and its workers, including those that died."""

    def close(self) -> None:
        """Abandon what runs, end the workers. Safe to call twice."""


class ThreadExecutor:
    """Runs tasks in threads of this process: for tasks that release the interpreter lock.

    A task that crashes takes the server with it, and a task that never ends takes a thread.
    """

    def __init__(self, workers: int) -> None:
        self.workers = self.up = workers
        self._states = TaskStates(workers)
        self._calls: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self._threads = [
            threading.Thread(target=self._work, name=f"task-{n}", daemon=True)
            for n in range(workers + 1)  # one more, for `meanwhile`
        ]
        for thread in self._threads:
            thread.start()

    def warm(self, changed: Callable[[str], None] = lambda _: None) -> "Future[None]":  # noqa: ARG002
        warmed: Future[None] = Future()
        self._calls.put(partial(_warm, self._states, warmed))
        return warmed

    def submit(self, call: Call, done: "Callable[[Future[Outcome]], None]") -> "Future[Outcome]":
        outcome: Future[Outcome] = Future()
        outcome.add_done_callback(done)
        self._calls.put(lambda: outcome.set_result(run_task(call, self._states)))
        return outcome

    def run(self, call: Call, *, meanwhile: Callable[[], None] | None) -> Outcome | None:
        if meanwhile is not None:
            self._calls.put(meanwhile)
        return run_task(call, self._states)

    def used_s(self) -> float:
        return time.process_time()

    def close(self) -> None:
        with contextlib.suppress(Empty):
            while True:
                self._calls.get_nowait()
        for _ in self._threads:
            self._calls.put(None)
        join_all(self._threads, CLOSE_WAIT_S)

    def _work(self) -> None:
        while (call := self._calls.get()) is not None:
            call()


EXECUTORS: dict[str, Callable[..., Executor]] = {
    "threads": lambda workers, *_: ThreadExecutor(workers),
    "processes": WorkerPool,
}


def _warm(states: TaskStates, warmed: "Future[None]") -> None:
    try:
        warm_kinds(states)
    except BaseException as error:  # noqa: BLE001 - a task's own code may raise anything
        warmed.set_exception(error)
    else:
        warmed.set_result(None)
