"""Several callers in virtual time without threads: each is a generator that yields what it waits for."""

from collections.abc import Collection, Generator
from concurrent.futures import Future
from functools import partial
from typing import Any

from offboard.loadgen.simulation.model.virtual_clock import VirtualClock
from offboard.robot_client.execution.race import Wait

Walk = Generator[Wait, None, None]


class Walker:
    """Moves one generator on: it runs until it waits, and goes on after the event that ends the wait.

    An exception of the generator is raised where the clock makes that event happen.
    """

    def __init__(self, clock: VirtualClock, walk: Walk) -> None:
        self._clock = clock
        self._walk = walk
        self._turn = 0  # of the wait that goes on; what belongs to an earlier one wakes nobody

    def begin(self) -> None:
        self._go_on(self._turn)

    def _go_on(self, turn: int) -> None:
        if turn != self._turn:
            return
        self._turn += 1
        try:
            pending, timeout_s = next(self._walk)
            while any(one.done() for one in pending):
                pending, timeout_s = next(self._walk)
        except StopIteration:
            return
        self._wait(pending, timeout_s, partial(self._go_on, self._turn))

    def _wait(
        self, pending: "Collection[Future[Any]]", timeout_s: float | None, go_on: "partial[None]"
    ) -> None:
        for one in pending:
            one.add_done_callback(lambda _: self._clock.at(self._clock.now_s(), go_on))
        if timeout_s is not None:
            self._clock.after(max(0.0, timeout_s), go_on)
