"""Who reads a socket: a thread of its own, or the caller who waits for the one answer that is due.

Who reads for himself need not be woken by another thread, which takes longer than most of what else a small
task costs. Nothing here knows of sockets.
"""

import math
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import TypeVar

from offboard.robot_client.sites.own_cpu import OWN_CPU

LINGER_S = 0.1  # for which the thread leaves the reading to callers after one has read

T = TypeVar("T")


class Answer(Future[T]):
    """Whoever waits for it takes turns meanwhile, where he may."""

    def __init__(self, turns: "Turns") -> None:
        super().__init__()
        self._turns = turns

    def result(self, timeout: float | None = None) -> T:
        return super().result(self._attended(timeout))

    def exception(self, timeout: float | None = None) -> BaseException | None:
        return super().exception(self._attended(timeout))

    def leave(self) -> None:
        """It is waited for among others: the thread is to read."""
        if not self.done():
            self._turns.leave()

    def _attended(self, timeout_s: float | None) -> float | None:
        """Take turns; what is left of the time then."""
        if self.done():
            return timeout_s
        until_s = None if timeout_s is None else time.perf_counter() + timeout_s
        self._turns.attend(self, until_s)
        return None if until_s is None else max(0.0, until_s - time.perf_counter())


class Turns:
    """A turn is `tend`, which does what is due, and `read`, which waits at most so many seconds for messages.

    One thread at a time has it. `asked`: how many answers are waited for; `expected`: whether any message is;
    `wake` makes a `read` under way return.
    """

    def __init__(
        self,
        tend: Callable[[], None],
        read: Callable[[float], None],
        *,
        asked: Callable[[], int],
        expected: Callable[[], bool],
        wake: Callable[[], None],
    ) -> None:
        self._tend = tend
        self._read = read
        self._asked = asked
        self._expected = expected
        self._wake = wake
        self.taken = threading.Lock()  # by whoever has the turn
        self._called = threading.Event()
        self._resting = False
        self._read_s = -math.inf  # when a caller last read, or would have
        self.closed = False

    def run(self, wait_s: float) -> None:
        """Take turns until `close`; for the thread. A turn waits at most `wait_s`."""
        while not self.closed:
            if not self._left_to_callers():
                with self.taken:
                    if not self.closed:
                        self._tend()
                        self._read(wait_s)

    def attend(self, answer: "Future[T]", until_s: float | None) -> None:
        """Take turns until there is an answer; returns early where somebody else reads."""
        if self._asked() > 1:
            self.leave()
            return
        self._read_s = time.perf_counter()
        if not self.taken.acquire(blocking=False):
            return  # the thread is reading; it makes way once nothing is expected
        try:
            while not (self.closed or answer.done()):
                self._tend()
                left_s = math.inf if until_s is None else until_s - time.perf_counter()
                if answer.done() or left_s <= 0:
                    break
                self._read(left_s)
        finally:
            self._read_s = time.perf_counter()
            self.taken.release()
            if self._expected():
                self.leave()

    def leave(self) -> None:
        """Something is expected that no caller reads for."""
        if self._resting:
            self._called.set()

    def call(self) -> None:
        """Something is to be done at once. Any thread."""
        self._called.set()
        self._wake()

    def close(self) -> None:
        self.closed = True
        self.call()

    def _left_to_callers(self) -> bool:
        """Whether callers read for now; the thread then rests until it is called, or for a while."""
        self._resting = True  # before it looks: whoever expects something from now on calls
        idle_s = time.perf_counter() - self._read_s
        linger_s = OWN_CPU.pause_s(LINGER_S)
        rests = self.taken.locked() or (idle_s < linger_s and not self._expected())
        if rests and not self._called.is_set():
            self._called.wait(linger_s)
            return True
        self._resting = False
        self._called.clear()
        return False
