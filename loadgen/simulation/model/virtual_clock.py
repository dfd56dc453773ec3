"""The virtual clock: events in order of time, and a clock that jumps to the next event while a caller waits.

Several callers at once are in `walker.py`.
"""

import heapq
import itertools
import math
from collections.abc import Callable, Collection
from concurrent.futures import Future
from typing import Any


class VirtualClock:
    """The clock of the offloader in a simulation (see `offboard.robot_client.sites.clock`), for one thread.

    Events happen only while a caller waits. Events at the same time happen in the order in which they were
    added.
    """

    def __init__(self) -> None:
        self._now_s = 0.0
        self._due: list[tuple[float, int, Callable[[], object]]] = []
        self._numbers = itertools.count()

    def now_s(self) -> float:
        return self._now_s

    def at(self, due_s: float, event: Callable[[], object]) -> None:
        """Call `event` at this time: at once if the time is past, never if it is infinite."""
        if due_s < math.inf:
            heapq.heappush(self._due, (max(due_s, self._now_s), next(self._numbers), event))

    def after(self, seconds: float, event: Callable[[], object]) -> None:
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
        if self._due and self._due[0][0] <= until_s:
            self._now_s, _, event = heapq.heappop(self._due)
            event()
            return True
        assert until_s < math.inf, "a caller waits for an event that never happens"
        self._now_s = max(self._now_s, until_s)
        return False
