"""The virtual clock: events in order of time, and a clock that jumps to the next event while a caller waits.

Several threads at once are in `shared_clock.py`; several callers without threads are left to simulations.
"""

import heapq
import itertools
import math
from collections.abc import Callable, Collection
from concurrent.futures import Future
from typing import Any


class VirtualClock:
    """The clock of an offloader in virtual time (see `robot_client.sites.waiting`), for one thread.

    Events happen only while a caller waits. Events at the same time happen in the order in which they were
    added.
    """

    def __init__(self) -> None:
        self._now_s = 0.0
        self._due: list[tuple[float, int, Callable[[], object]]] = []
        self._numbers = itertools.count()

    def now_s(self) -> float:
        """Seconds of virtual time since the clock was made."""
        return self._now_s

    def at(self, due_s: float, event: Callable[[], object]) -> None:
        """Call `event` at this time: at once if the time is past, never if it is infinite."""
        if due_s < math.inf:
            heapq.heappush(self._due, (max(due_s, self._now_s), next(self._numbers), event))

    def after(self, seconds: float, event: Callable[[], object]) -> None:
        """Call `event` this many seconds from now."""
        self.at(self._now_s + seconds, event)

    def wait(self, pending: "Collection[Future[Any]]", timeout_s: float | None = None) -> None:
        """Return when one of these futures is done, or after `timeout_s`."""
        until_s = math.inf if timeout_s is None else self._now_s + timeout_s
        while not any(future.done() for future in pending) and self.step(until_s):
            pass

    def pass_by(self, seconds: float) -> None:
        """Let this much time pass."""
        self.wait((), seconds)

    def step(self, until_s: float) -> bool:
        """Make the next event happen, if it is due by `until_s`; else set the time to `until_s`.

        Returns whether an event happened.
        """
        event = self._next(until_s)
        if event is not None:
            event()
        return event is not None

    def _next(self, until_s: float) -> Callable[[], object] | None:
        """Take the next event, and set the time to it, if it is due by `until_s`; else to `until_s`."""
        if self._due and self._due[0][0] <= until_s:
            self._now_s, _, event = heapq.heappop(self._due)
            return event
        assert until_s < math.inf, "a caller waits for an event that never happens"
        self._now_s = max(self._now_s, until_s)
        return None
