"""Which thread reads the socket, and which thread runs a task.

With a thread executor, the thread that has read a request also runs it, and another thread goes on reading:
waking a thread would take longer than a small task (leader and followers, Schmidt et al. 2000). With worker
processes one thread reads all the time. What a message means is decided in `server`.
"""

import logging
import threading
from collections.abc import Callable
from concurrent import futures
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial

from offboard.cloud_server.executors.executor import Executor
from offboard.cloud_server.executors.task_run import Call, Outcome
from offboard.cloud_server.fair_queue import Work

log = logging.getLogger("offboard.cloud_server")


@dataclass(slots=True)
class _Start:
    """One call of `ReaderThreads._start`, which may still be running."""

    chosen: list[Work]
    thread: int
    ended: bool = False


class ReaderThreads:
    """Threads that take turns at reading the socket.

    Parameters: `turn` waits for messages and reads them; `answered` gets the outcome of a task. Both return
    the work to start next. `wanted` tells whether anybody waits for an answer, `over` whether to stop.
    """

    def __init__(
        self,
        executor: Executor,
        *,
        turn: Callable[[], list[Work]],
        answered: Callable[[Work, Outcome], list[Work]],
        wanted: Callable[[Work], bool],
        over: Callable[[], bool],
    ) -> None:
        self._executor = executor
        self._turn = turn
        self._answered = answered
        self._wanted = wanted
        self._over = over
        self._ended: Future[None] = Future()  # set by the thread that read last

    def run(self) -> None:
        """Read until `over`. Raises what a turn raised."""
        threading.Thread(target=self._lead, name="loop", daemon=True).start()
        self._ended.result()

    def leave(self, timeout_s: float) -> None:
        """Wait until no thread reads any more."""
        futures.wait([self._ended], timeout_s)

    def _lead(self) -> None:
        """Read until this thread gets a task to run; then another thread leads."""
        try:
            while not self._over():
                chosen = self._turn()
                if chosen and self._run(chosen):
                    return
            self._ended.set_result(None)
        except BaseException as error:  # noqa: BLE001 - `run` raises it
            self._ended.set_exception(error)

    def _run(self, chosen: list[Work]) -> bool:
        """Start this work, the last of it in this thread if possible. True if another thread leads now."""
        *others, here = chosen
        self._start(others)
        outcome = self._executor.run(self._call(here), meanwhile=self._lead)
        if outcome is None:
            self._start([here])
            return False
        try:
            self._start(self._answered(here, outcome))
        except Exception:  # as in the callback of a future: the leading thread must go on
            text = "task %d of kind %s could not be answered; remedy: report this traceback"
            log.exception(text, here.request.id, here.request.kind)
        return True

    def _start(self, chosen: list[Work]) -> None:
        """Give work to the executor. Called in any thread."""
        start = _Start(chosen, threading.get_ident())
        while chosen:
            work = chosen.pop(0)
            self._executor.submit(self._call(work), partial(self._finished, work, start))
        start.ended = True

    def _call(self, work: Work) -> Call:
        request, left_s = work.request, work.request.budget_s - work.queue_s
        wanted = partial(self._wanted, work)
        return Call(request.kind, request.body, work.blobs, wanted, budget_s=left_s)

    def _finished(self, work: Work, start: _Start, future: "Future[Outcome]") -> None:
        """Called in the thread of a worker, so that no reply and no task waits for the reading thread."""
        chosen = self._answered(work, future.result())
        if start.thread == threading.get_ident() and not start.ended:
            start.chosen += chosen  # `submit` failed at once; starting here would nest calls
        else:
            self._start(chosen)
