"""The virtual clock for several threads, as `deadline_s`, `submit`, `run` and `map` start them.

The threads that wait take turns to make events happen. Time stands still while a thread works.
"""

import threading
import time
from collections.abc import Callable, Collection
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any

from offboard.robot_client.sites.runner import TIMEOUT_MAX_S
from offboard.testing.virtual_clock import VirtualClock
from offboard.testing.virtual_driver import VirtualAnswer

POLL_S = 0.001  # of real time: how long a thread lets others work before it looks again
POLLS = 3  # without a sign of a thread: after that, nobody waits for it
STUCK_S = 30.0  # of real time without an event: no test waits longer for a thread
LONGEST_S = 2 * TIMEOUT_MAX_S  # of virtual time


@dataclass(eq=False, slots=True)
class _Wait:
    """One wait of one thread: for these futures, or until this virtual time.

    moves: whether events can end it. If not, it waits for what other threads do.
    polls: for which other threads, which start together with this one, are let go first.
    since_s: real time of its start. ended: its time has passed.
    """

    pending: "Collection[Future[Any]]"
    until_s: float
    thread: int
    moves: bool
    polls: int
    since_s: float = field(default_factory=time.perf_counter)
    ended: bool = False

    @property
    def over(self) -> bool:
        return self.ended or any(future.done() for future in self.pending)


class SharedClock(VirtualClock):
    """Virtual time for several threads: it passes while they wait, and jumps from one event to the next.

    With one thread, nothing really waits, and each run of a test is the same. With several threads, time
    stands still while one of them works: it has used the clock, and then not waited, in the last few
    milliseconds. So on a busy computer, the order in which threads go on may differ from run to run.

    AssertionError if a thread waits for what never happens: 48 hours of virtual time, or 30 s of real time in
    which nothing happens.
    """

    def __init__(self) -> None:
        super().__init__()
        self._changed = threading.Condition(threading.Lock())
        self._waits: list[_Wait] = []  # the last one that can makes the events happen
        self._working: dict[
            int, int
        ] = {}  # threads that do not wait, and for how many polls they still count
        self._maker = threading.get_ident()
        self._moved_s = time.perf_counter()  # real time of the last event

    def now_s(self) -> float:
        """Seconds of virtual time since the clock was made."""
        with self._changed:
            self._working[threading.get_ident()] = POLLS
            return self._now_s

    def at(self, due_s: float, event: Callable[[], object]) -> None:
        """Call `event` at this time, in the thread that waits then: at once if the time is past."""
        with self._changed:
            super().at(due_s, event)

    def wait(self, pending: "Collection[Future[Any]]", timeout_s: float | None = None) -> None:
        me = threading.get_ident()
        moves = not pending or any(isinstance(one, VirtualAnswer) for one in pending)
        with self._changed:
            until_s = self._now_s + (LONGEST_S if timeout_s is None else timeout_s)
            wait = _Wait(pending, until_s, thread=me, moves=moves, polls=0 if me == self._maker else POLLS)
            self._waits.append(wait)
            self._working.pop(me, None)
            try:
                while not wait.over:
                    self._go_on(wait)
            finally:
                self._waits.remove(wait)
                self._working[me] = POLLS
                self._changed.notify_all()
        if timeout_s is None and wait.ended:
            raise AssertionError(f"nothing has come for {LONGEST_S:g} s of virtual time, and nothing will")

    def step(self, until_s: float) -> bool:
        raise NotImplementedError("threads share this clock: use `wait` or `pass_by`")

    def _go_on(self, wait: _Wait) -> None:
        """Make the next event happen, or let other threads go on. Called under the lock."""
        leads = wait is next((one for one in reversed(self._waits) if one.moves), None)
        others = [one for one in self._working if one != wait.thread]
        if leads and not (others or wait.polls or self._others_over(wait.thread)):
            self._make_next(wait.thread)
            return
        if time.perf_counter() - max(wait.since_s, self._moved_s) > STUCK_S:
            raise AssertionError(f"virtual time has stood still for {STUCK_S:g} s: a thread hangs")
        if not self._changed.wait(POLL_S) and leads:
            wait.polls = max(0, wait.polls - 1)
            self._working = {one: left - 1 for one, left in self._working.items() if left > 1}

    def _others_over(self, me: int) -> bool:
        return any(one.over for one in self._waits if one.thread != me)

    def _make_next(self, me: int) -> None:
        """Make the next event happen, or end the waits whose time has come before that."""
        event = self._next(min(one.until_s for one in self._waits if not one.ended))
        self._moved_s = time.perf_counter()
        if event is None:
            for one in self._waits:
                one.ended = one.ended or one.until_s <= self._now_s
        else:  # it may call the function of a task, which may use this clock
            self._working[me] = POLLS
            self._changed.release()
            try:
                event()
            finally:
                self._changed.acquire()
                self._working.pop(me, None)
        self._changed.notify_all()
