"""Virtual time for several tasks at once: each task has a thread, and only one thread runs at a time.

Events and their order are those of `virtual_clock.py`.
"""

import math
from collections.abc import Callable, Collection
from concurrent.futures import Future
from threading import Semaphore, Thread
from typing import Any

from offboard.loadgen.simulation.model.virtual_clock import VirtualClock


class LockstepClock(VirtualClock):
    """A virtual clock on which several callers can wait at the same time, each in its own thread.

    A caller runs until it waits, and then gives control back to the thread that made the clock. Events
    happen in that thread, so every run has the same order. If one event wakes up several callers, they
    continue in the order in which they started to wait.
    """

    def __init__(self) -> None:
        super().__init__()
        self._running: _Caller | None = None
        self._waiting: list[_Caller] = []

    def begin(self, call: Callable[[], None]) -> None:
        """Run `call` in a new thread until it waits or ends; its exceptions are raised here or in `step`."""
        self._let_run(_Caller(call))

    def wait(self, pending: "Collection[Future[Any]]", timeout_s: float | None = None) -> None:
        caller = self._running
        if caller is None:
            super().wait(pending, timeout_s)
            return
        caller.pending = pending
        caller.until_s = math.inf if timeout_s is None else self.now_s() + timeout_s
        if caller.waits(self.now_s()):
            self.at(caller.until_s, lambda: None)  # so that the time does not jump past it
            self._waiting.append(caller)
            caller.pause()

    def step(self, until_s: float) -> bool:
        happened = super().step(until_s)
        for caller in [one for one in self._waiting if not one.waits(self.now_s())]:
            self._waiting.remove(caller)
            self._let_run(caller)
        return happened

    def _let_run(self, caller: "_Caller") -> None:
        self._running = caller
        try:
            caller.resume()
        finally:
            self._running = None


class _Caller:
    """A thread that waits for one of `pending`, or until `until_s`."""

    def __init__(self, call: Callable[[], None]) -> None:
        self.pending: Collection[Future[Any]] = ()
        self.until_s = 0.0
        self._call = call
        self._mine, self._clocks = Semaphore(0), Semaphore(0)  # permission to run: this thread, the clock's
        self._failure: BaseException | None = None
        Thread(target=self._run, name="caller", daemon=True).start()

    def waits(self, now_s: float) -> bool:
        return now_s < self.until_s and not any(future.done() for future in self.pending)

    def resume(self) -> None:
        """Let the thread run until it pauses or ends. Called by the thread of the clock."""
        self._mine.release()
        self._clocks.acquire()
        if self._failure is not None:
            raise self._failure

    def pause(self) -> None:
        """Give control back to the thread of the clock. Called by this thread."""
        self._clocks.release()
        self._mine.acquire()

    def _run(self) -> None:
        self._mine.acquire()
        try:
            self._call()
        except BaseException as failure:  # noqa: BLE001 - `resume` raises it
            self._failure = failure
        self._clocks.release()
