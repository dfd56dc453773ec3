"""Who reads the socket, and who runs the tasks.

Where tasks run in threads, the thread that has read a request runs it, and another one reads on: waking a
thread takes longer than a small task (leader and followers, Schmidt et al. 2000). Worker processes get their
tasks from the one thread that reads, and from the threads that keep them.
"""

import logging
import threading
from collections.abc import Callable
from concurrent import futures
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial

from offboard.cloud_server.executors import Executor, Outcome
from offboard.cloud_server.fair_queue import Work

log = logging.getLogger("offboard.cloud_server")


@dataclass(slots=True)
class _Start:
    """A call of `Crew._start` that may be under way."""

    chosen: list[Work]
    thread: int
    ended: bool = False


class Crew:
    """`turn` waits for messages and takes them, `answered` takes the outcome of a task; both tell what work
    is to be started. `wanted`: whether anybody waits for it. `over`: whether there are no more turns.
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
        self._ended: Future[None] = Future()  # when the last one has led

    def run(self) -> None:
        """Until it is over; raises what a turn raised."""
        threading.Thread(target=self._lead, name="loop", daemon=True).start()
        self._ended.result()

    def leave(self, timeout_s: float) -> None:
        """Wait until nobody takes turns any more."""
        futures.wait([self._ended], timeout_s)

    def _lead(self) -> None:
        """Take turns until there is a task to run here: another thread goes on then."""
        try:
            while not self._over():
                chosen = self._turn()
                if chosen and self._run(chosen):
                    return
            self._ended.set_result(None)
        except BaseException as error:  # noqa: BLE001 - whoever called `run` gets it
            self._ended.set_exception(error)

    def _run(self, chosen: list[Work]) -> bool:
        """Start this work, one of it in this thread where it may; whether another one leads since then."""
        *others, here = chosen
        self._start(others)
        request, wanted = here.request, partial(self._wanted, here)
        outcome = self._executor.run(request.kind, request.body, here.blobs, wanted, meanwhile=self._lead)
        if outcome is None:
            self._start([here])
            return False
        try:
            self._start(self._answered(here, outcome))
        except Exception:  # as in the callback of a future: whoever leads goes on
            log.exception("task %d of kind %s could not be answered", request.id, request.kind)
        return True

    def _start(self, chosen: list[Work]) -> None:
        """Hand work to the executor. Any thread."""
        start = _Start(chosen, threading.get_ident())
        while chosen:
            work = chosen.pop(0)
            request, left_s = work.request, work.request.budget_s - work.queue_s
            wanted, done = partial(self._wanted, work), partial(self._finished, work, start)
            self._executor.submit(request.kind, request.body, work.blobs, wanted, left_s, done)
        start.ended = True

    def _finished(self, work: Work, start: _Start, future: "Future[Outcome]") -> None:
        """Called in a worker's thread: neither the reply nor the next request waits for who reads."""
        chosen = self._answered(work, future.result())
        if start.thread == threading.get_ident() and not start.ended:
            start.chosen += chosen  # refused at once: calls would nest
        else:
            self._start(chosen)
