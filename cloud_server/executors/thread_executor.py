"""The executor that runs tasks in threads of this process."""

import contextlib
import threading
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from queue import Empty, SimpleQueue

from offboard.cloud_server.executors.executor import Call, Executor, Outcome, run_task, warm_kinds
from offboard.cloud_server.executors.joint_run import run_joint
from offboard.common.task_call import join_all
from offboard.common.task_states import TaskStates

# To wait for threads whose tasks are abandoned. This may be short: `--drain-s` was the time for those tasks,
# and if some still run, `cloud-server` ends without the teardown in which native code could crash.
CLOSE_WAIT_S = 1.0


class ThreadExecutor(Executor):
    """Runs tasks in threads of this process: for tasks that release the interpreter lock.

    A task that crashes takes the server with it, and a task that never ends takes a thread.
    """

    name = "threads"

    def __init__(self, workers: int) -> None:
        self.workers = workers
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
        run = run_joint if call.more else run_task
        self._calls.put(lambda: outcome.set_result(run(call, self._states)))
        return outcome

    def run(self, call: Call, *, meanwhile: Callable[[], None] | None) -> Outcome | None:
        if meanwhile is not None:
            self._calls.put(meanwhile)
        return (run_joint if call.more else run_task)(call, self._states)

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


def _warm(states: TaskStates, warmed: "Future[None]") -> None:
    try:
        warm_kinds(states)
    except BaseException as error:  # noqa: BLE001 - a task's own code may raise anything
        warmed.set_exception(error)
    else:
        warmed.set_result(None)
