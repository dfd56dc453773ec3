"""Virtual time for several tasks at once: a thread each, of which one at most ever runs."""

import math
from collections.abc import Callable, Collection
from concurrent.futures import Future
from threading import Semaphore, Thread
from typing import Any

from offboard.loadgen.simulation.model.clock import VirtualClock


class LockstepClock(VirtualClock):
    """A virtual clock on which askers wait too: threads that run until they wait, then hand the turn back.

    Events happen in the thread that made the clock, and so is decided who is next: a run is the same each
    time. Askers whose waits end at one event go on in the order in which they began to wait.
    """

    def __init__(self) -> None:
        super().__init__()
        self._turn: _Asker | None = None
        self._waiting: list[_Asker] = []

    def begin(self, ask: Callable[[], None]) -> None:
        """Let a new asker run until it waits or ends; what it raises is raised here, now or later."""
        self._let_run(_Asker(ask))

    def wait(self, pending: "Collection[Future[Any]]", timeout_s: float | None = None) -> None:
        asker = self._turn
        if asker is None:
            super().wait(pending, timeout_s)
            return
        asker.pending = pending
        asker.until_s = math.inf if timeout_s is None else self.now_s() + timeout_s
        if asker.waits(self.now_s()):
            self.at(asker.until_s, lambda: None)  # time does not go past it
            self._waiting.append(asker)
            asker.hand_back()

    def step(self, until_s: float) -> bool:
        happened = super().step(until_s)
        for asker in [one for one in self._waiting if not one.waits(self.now_s())]:
            self._waiting.remove(asker)
            self._let_run(asker)
        return happened

    def _let_run(self, asker: "_Asker") -> None:
        self._turn = asker
        try:
            asker.go_on()
        finally:
            self._turn = None


class _Asker:
    """One thread; `pending` and `until_s` are what it waits for."""

    def __init__(self, ask: Callable[[], None]) -> None:
        self.pending: Collection[Future[Any]] = ()
        self.until_s = 0.0
        self._ask = ask
        self._mine, self._others = Semaphore(0), Semaphore(0)  # whose turn it is
        self._failure: BaseException | None = None
        Thread(target=self._run, name="asker", daemon=True).start()

    def waits(self, now_s: float) -> bool:
        return now_s < self.until_s and not any(future.done() for future in self.pending)

    def go_on(self) -> None:
        """Give it the turn until it hands it back or ends. Called by the clock's own thread."""
        self._mine.release()
        self._others.acquire()
        if self._failure is not None:
            raise self._failure

    def hand_back(self) -> None:
        self._others.release()
        self._mine.acquire()

    def _run(self) -> None:
        self._mine.acquire()
        try:
            self._ask()
        except BaseException as failure:  # noqa: BLE001 - go_on raises it
            self._failure = failure
        self._others.release()
