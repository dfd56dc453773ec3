"""Virtual time: a heap of events, and a clock that goes from one to the next as somebody waits."""

import heapq
import itertools
import math
from collections.abc import Callable, Collection
from concurrent.futures import Future
from typing import Any


class VirtualClock:
    """The offloader's clock in a simulation (`offboard.robot_client.sites.clock`). For one thread.

    Nothing happens but while somebody waits; events due at one instant happen in the order they were set.
    """

    def __init__(self) -> None:
        self._now_s = 0.0
        self._due: list[tuple[float, int, Callable[[], object]]] = []
        self._numbers = itertools.count()

    def now_s(self) -> float:
        return self._now_s

    def at(self, due_s: float, event: Callable[[], object]) -> None:
        """Make it happen then, or next where that is past; never where it is infinite."""
        if due_s < math.inf:
            heapq.heappush(self._due, (max(due_s, self._now_s), next(self._numbers), event))

    def after(self, seconds: float, event: Callable[[], object]) -> None:
        self.at(self._now_s + seconds, event)

    def wait(self, pending: "Collection[Future[Any]]", timeout_s: float | None = None) -> None:
        """Return once one of these futures is done, or after `timeout_s`."""
        until_s = math.inf if timeout_s is None else self._now_s + timeout_s
        while not any(future.done() for future in pending) and self.step(until_s):
            pass

    def pass_by(self, seconds: float) -> None:
        """Let so much time go by."""
        self.wait((), seconds)

    def step(self, until_s: float) -> bool:
        """The next event; without one up to then, only the time comes, and False is returned."""
        if self._due and self._due[0][0] <= until_s:
            self._now_s, _, event = heapq.heappop(self._due)
            event()
            return True
        assert until_s < math.inf, "somebody waits for what never happens"
        self._now_s = max(self._now_s, until_s)
        return False
