"""Which thread reads the socket, and which thread runs a task.

With a thread executor, the thread that has read a request also runs it, and another thread goes on reading
(leader and followers, Schmidt et al. 2000). For a task of a short kind no other thread wakes: waking one
takes longer than the task. If that task is not short after all, a watching thread lets another one read. With
worker processes one thread reads all the time. What a message means is decided in `server`.
"""

import logging
import threading
import time
from collections.abc import Callable
from concurrent import futures
from concurrent.futures import Future
from dataclasses import dataclass, replace
from functools import partial

from offboard.cloud_server.executors.executor import Call, Executor, Outcome
from offboard.cloud_server.fair_queue import Work

SHORT_S = 0.0005  # tasks of a kind that usually take less are short
USUAL_RATE = 0.1  # share of each new run time in the usual run time of a kind
AWAY_S = 0.002  # the reading thread may run short tasks for this long; then another thread reads
WATCHES_S = 0.1  # after the last short task, until the watching thread rests

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
        self._usual_s: dict[str, float] = {}  # run time of a task, by kind
        self._absence = Absence(self._lead_in_new_thread, self._start)

    def run(self) -> None:
        """Read until `over`. Raises what a turn raised."""
        watch = partial(self._absence.watch, self._ended.done)
        threading.Thread(target=watch, name="watch", daemon=True).start()
        self._lead_in_new_thread()
        try:
            self._ended.result()
        finally:
            self._absence.begin([])  # wakes the watching thread, which ends

    def leave(self, timeout_s: float) -> None:
        """Wait until no thread reads any more."""
        futures.wait([self._ended], timeout_s)

    def _lead_in_new_thread(self) -> None:
        threading.Thread(target=self._lead, name="loop", daemon=True).start()

    def _lead(self) -> None:
        """Read until this thread gets a task to run; then another thread leads."""
        try:
            while not self._over():
                chosen = self._turn()
                if chosen and (self._run_short(chosen) or (chosen and self._run(chosen))):
                    return
            self._ended.set_result(None)
        except BaseException as error:  # noqa: BLE001 - `run` raises it
            self._ended.set_exception(error)

    def _run(self, chosen: list[Work]) -> bool:
        """Start this work, the last of it in this thread if possible. True if another thread leads now.

        Then this thread goes on with what waits: a plan that another thread has to wake up for starts later.
        """
        *others, here = chosen
        self._start(others)
        outcome = self._executor.run(self._call(here), meanwhile=self._lead)
        if outcome is None:
            self._start([here])
            return False
        while outcome is not None and (chosen := self._answer(here, outcome)):
            *others, here = chosen
            self._start(others)
            outcome = self._executor.run(self._call(here), meanwhile=None)
        return True

    def _run_short(self, chosen: list[Work]) -> bool:
        """Run the short tasks among this work here, and remove them. True if another thread leads now."""
        if not any(map(self._short, chosen)):
            return False
        self._start([work for work in chosen if not self._short(work)])
        chosen[:] = filter(self._short, chosen)
        away, until_s = self._absence.begin(chosen), time.perf_counter() + AWAY_S
        while time.perf_counter() < until_s and (work := self._absence.next(away, self._short)) is not None:
            outcome = self._executor.run(self._call(work), meanwhile=None)
            if outcome is None:
                self._start([work])
            elif (more := self._answer(work, outcome)) and not self._absence.add(away, more):
                self._start(more)
        return not self._absence.end(away)

    def _short(self, work: Work) -> bool:
        return self._usual_s.get(work.request.kind, SHORT_S) < SHORT_S

    def _answer(self, work: Work, outcome: Outcome) -> list[Work]:
        """Send the reply of a task that ran in this thread; returns the work to start in its place.

        One long task makes its kind long for a while. A failed one may have ended before its work began.
        """
        if outcome.status == "ok" or outcome.run_s >= SHORT_S:
            usual_s = self._usual_s.get(work.request.kind, 0.0)
            self._usual_s[work.request.kind] = max(
                outcome.run_s, usual_s + USUAL_RATE * (outcome.run_s - usual_s)
            )
        try:
            return self._answered(work, outcome)
        except Exception:  # as in the callback of a future: the leading thread must go on
            text = "task %d of kind %s could not be answered; remedy: report this traceback"
            log.exception(text, work.request.id, work.request.kind)
            return []

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
        call = Call(request.kind, request.body, work.blobs, wanted, budget_s=left_s)
        return self._joint(call, work.more) if work.more else call

    def _joint(self, call: Call, others: tuple[Work, ...]) -> Call:
        """This call with those that run together with it: it ends when the last of them must."""
        more = tuple(map(self._call, others))
        wanted = [one.wanted for one in (call, *more)]
        left_s = max(one.budget_s for one in (call, *more))
        return replace(call, more=more, wanted=lambda: any(one() for one in wanted), budget_s=left_s)

    def _finished(self, work: Work, start: _Start, future: "Future[Outcome]") -> None:
        """Called in the thread of a worker, so that no reply and no task waits for the reading thread."""
        chosen = self._answered(work, future.result())
        if start.thread == threading.get_ident() and not start.ended:
            start.chosen += chosen  # `submit` failed at once; starting here would nest calls
        else:
            self._start(chosen)


class Absence:
    """Notes that the reading thread is away, running short tasks.

    If it stays away, `take_over` is called, and `start` with the rest of its work. `watch` runs in a thread
    of its own, which rests while no short tasks run.
    """

    def __init__(self, take_over: Callable[[], None], start: Callable[[list[Work]], None]) -> None:
        self._take_over = take_over
        self._start = start
        self._lock = threading.Lock()  # protects the rest, and who reads
        self._rest: list[Work] = []
        self._since_s: float | None = None  # None: the reading thread is there
        self._last_s = 0.0
        self._watched = False
        self._wanted = threading.Event()

    def begin(self, rest: list[Work]) -> float:
        """The reading thread leaves to run `rest`; returns what the next methods need."""
        self._rest = rest
        self._since_s = self._last_s = now_s = time.perf_counter()
        if not self._watched:
            self._wanted.set()
        return now_s

    def next(self, since_s: float, fits: Callable[[Work], bool]) -> Work | None:
        """The first of the rest. None if it does not fit, and if nothing is left or another thread reads."""
        with self._lock:
            mine = self._since_s == since_s and self._rest
            return self._rest.pop(0) if mine and fits(self._rest[0]) else None

    def add(self, since_s: float, more: list[Work]) -> bool:
        """Add work to the rest. False if another thread reads by now."""
        with self._lock:
            in_time = self._since_s == since_s
            if in_time:
                self._rest += more
        return in_time

    def end(self, since_s: float) -> bool:
        """The thread is back. False if another thread reads by now."""
        with self._lock:
            in_time = self._since_s == since_s
            if in_time:
                self._since_s = None
        return in_time

    def watch(self, over: Callable[[], bool]) -> None:
        """Let another thread take over after each absence that lasts too long, until `over`."""
        while not over():
            self._watched = False  # before looking: a thread that leaves from now on wakes this one
            if time.perf_counter() - self._last_s > WATCHES_S and self._since_s is None:
                self._wanted.wait()
            self._watched = True
            self._wanted.clear()
            time.sleep(AWAY_S)
            self._start(self._let_take_over(over))

    def _let_take_over(self, over: Callable[[], bool]) -> list[Work]:
        """If the absence lasts too long, let another thread read; returns the work that nobody has begun."""
        with self._lock:
            since_s = self._since_s
            if since_s is None or time.perf_counter() - since_s <= AWAY_S or over():
                return []
            rest, self._rest[:] = self._rest[:], []
            self._since_s = None  # before the other thread reads: it may leave at once
            try:
                self._take_over()
            except RuntimeError:  # no thread can be started: the one that is away goes on reading later
                self._since_s = since_s
        return rest
