"""The runner of the robot's own computer."""

import time
from concurrent.futures import Future, ThreadPoolExecutor

from common import cpu
from common.cpu import SELF
from common.errors import OffloadError, TaskFailed, describe
from common.tasks import Kind, Task
from robot_client.load import Load
from robot_client.runner import ONBOARD, Condition, Execution


class OnboardRunner:
    """Runs tasks in this process, `workers` at a time; a waiting task's seconds include its wait."""

    site = ONBOARD

    def __init__(self, workers: int = 1) -> None:
        self._pool = ThreadPoolExecutor(workers, thread_name_prefix="onboard")
        self._futures: dict[int, Future[Execution]] = {}  # of tasks that have not ended
        self._load = Load(SELF)

    def unavailable(self, kind: Kind) -> str | None:  # noqa: ARG002 - onboard always exists
        return None

    def submit(self, task: Task, budget_s: float) -> "Future[Execution]":  # noqa: ARG002 - a thread cannot be stopped
        try:
            future = self._pool.submit(_run, task, time.perf_counter())
        except RuntimeError as error:
            raise OffloadError("the onboard runner is closed") from error
        self._futures[task.id] = future
        future.add_done_callback(lambda _: self._futures.pop(task.id, None))
        return future

    def cancel(self, task: Task) -> None:
        """Only a task that still waits for a worker: a thread cannot be stopped."""
        future = self._futures.get(task.id)
        if future is not None:
            future.cancel()

    def condition(self) -> Condition:
        return Condition(load=self._load.share())

    def close(self) -> None:
        self._pool.shutdown(wait=False, cancel_futures=True)


def _run(task: Task, published: float) -> Execution:
    cpu_before_s, started = cpu.used_s(), time.perf_counter()
    value, failure = None, None
    try:
        value = task.kind.function(*task.args)
    except BaseException as error:  # noqa: BLE001 - whatever a user's function raises is the task's failure
        failure = TaskFailed(describe(error))
        failure.__cause__ = error
    cpu_s = cpu.used_s() - cpu_before_s
    # Asked for its CPU time the kernel charges this thread, and under a quota stops it until what it overdrew
    # is paid: the caller waits for that too.
    now = time.perf_counter()
    return Execution(
        ONBOARD,
        now - published,
        value,
        failure,
        queue_s=started - published,
        run_s=now - started,
        network_s=0.0,
        cpu_s=cpu_s,
    )
