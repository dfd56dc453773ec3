"""How callers wait: the clock of the offloader, and who reads a socket meanwhile.

Simulations have a clock of their own. How a socket is read is left to `cloud`.
"""

import contextlib
import math
import threading
import time
from collections.abc import Callable, Sequence
from concurrent import futures
from concurrent.futures import CancelledError, Future
from typing import Any, Protocol, TypeVar

LINGER_S = 0.1  # for which the thread leaves the socket alone after a caller has read from it

T = TypeVar("T")


class Clock(Protocol):
    """Seconds since an arbitrary start; they never go backwards."""

    def now_s(self) -> float: ...

    def wait(self, pending: "Sequence[Future[Any]]", timeout_s: float | None = None) -> None:
        """Return as soon as one of these futures is done, or after `timeout_s`."""


class SystemClock:
    """The clock of this host."""

    now_s = staticmethod(time.perf_counter)

    def wait(self, pending: "Sequence[Future[Any]]", timeout_s: float | None = None) -> None:
        if timeout_s is not None:
            timeout_s = min(timeout_s, threading.TIMEOUT_MAX)  # a longer one raises OverflowError
        if len(pending) == 1:  # takes half as long as the general case
            with contextlib.suppress(futures.TimeoutError, CancelledError):
                pending[0].exception(timeout_s)
            return
        for future in pending:
            if isinstance(future, Answer):
                future.leave_to_thread()
        futures.wait(pending, timeout_s, futures.FIRST_COMPLETED)


class SharedReader:
    """Lets one thread at a time read a socket: a background thread, or a caller that waits.

    A caller that waits for the only answer that is due reads by itself, so that no other thread must wake it.
    For a small task that wake-up takes longer than most of the other work.
    The thread that has the turn does what is due (`tend`), then reads (`read`).

    tend: does what is due.
    read: waits for messages for at most the given seconds, and takes those that have come.
    unanswered: returns how many answers callers wait for.
    expects_message: returns whether any message is expected.
    wake: makes a `read` that is under way return.
    pause_s: turns a usual pause into the pause of a robot that is busy.
    """

    def __init__(
        self,
        tend: Callable[[], None],
        read: Callable[[float], None],
        *,
        unanswered: Callable[[], int],
        expects_message: Callable[[], bool],
        wake: Callable[[], None],
        pause_s: Callable[[float], float] = float,
    ) -> None:
        self._tend = tend
        self._read = read
        self._unanswered = unanswered
        self._expects_message = expects_message
        self._wake = wake
        self._pause_s = pause_s
        self.turn = threading.Lock()  # held by the thread that has the turn
        self._called = threading.Event()
        self._thread_rests = False
        self._caller_read_s = -math.inf  # when a caller last had the turn, or asked for it
        self.closed = False

    def run(self, wait_s: float) -> None:
        """Take turns until `close`. For the background thread; each turn waits for at most `wait_s`."""
        while not self.closed:
            if not self._left_to_callers():
                with self.turn:
                    if not self.closed:
                        self._tend()
                        self._read(wait_s)

    def read_until(self, answer: "Future[T]", until_s: float | None) -> None:
        """Take turns until the answer is there. Returns early if another thread must read."""
        if self._unanswered() > 1:
            self.call_thread()
            return
        self._caller_read_s = time.perf_counter()
        if not self.turn.acquire(blocking=False):
            return  # the thread reads; it stops once no message is expected
        try:
            while not (self.closed or answer.done()):
                self._tend()
                left_s = math.inf if until_s is None else until_s - time.perf_counter()
                if answer.done() or left_s <= 0:
                    break
                self._read(left_s)
        finally:
            self._caller_read_s = time.perf_counter()
            self.turn.release()
            if self._expects_message():
                self.call_thread()

    def call_thread(self) -> None:
        """A message is expected that no caller reads."""
        if self._thread_rests:
            self._called.set()

    def interrupt(self) -> None:
        """Something is due at once. Any thread may call this."""
        self._called.set()
        self._wake()

    def close(self) -> None:
        self.closed = True
        self.interrupt()

    def _left_to_callers(self) -> bool:
        """Whether callers read for now; if so, the thread rests until it is called, or for a while."""
        self._thread_rests = True  # set before looking: a caller that expects a message from now on calls
        idle_s, linger_s = time.perf_counter() - self._caller_read_s, self._pause_s(LINGER_S)
        rests = self.turn.locked() or (idle_s < linger_s and not self._expects_message())
        if rests and not self._called.is_set():
            self._called.wait(linger_s)
            return True
        self._thread_rests = False
        self._called.clear()
        return False


class Answer(Future[T]):
    """A future whose waiting caller reads the socket, if it is the only one that waits."""

    def __init__(self, reader: SharedReader) -> None:
        super().__init__()
        self._reader = reader

    def result(self, timeout: float | None = None) -> T:
        return super().result(self._read(timeout))

    def exception(self, timeout: float | None = None) -> BaseException | None:
        return super().exception(self._read(timeout))

    def leave_to_thread(self) -> None:
        """The caller waits for several futures at once, so the thread must read."""
        if not self.done():
            self._reader.call_thread()

    def _read(self, timeout_s: float | None) -> float | None:
        """Take turns; return the seconds that are left of the timeout."""
        if self.done():
            return timeout_s
        until_s = None if timeout_s is None else time.perf_counter() + timeout_s
        self._reader.read_until(self, until_s)
        return None if until_s is None else max(0.0, until_s - time.perf_counter())
