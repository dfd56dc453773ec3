"""The timers of the relay: an event loop selector that ends its waits to the microsecond."""

import select
import selectors
import time

SPIN_S = 0.0003


class PreciseSelector(selectors.EpollSelector):
    """Ends a wait on time, where epoll alone rounds every timer up to a whole millisecond.

    A core that sleeps wakes up about 0.2 ms late, so the last SPIN_S of a wait are polled.
    """

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        if timeout is None or timeout <= 0:
            return super().select(timeout)
        end = time.monotonic() + timeout
        if timeout > SPIN_S:
            select.select([self.fileno()], [], [], timeout - SPIN_S)
        while not (ready := super().select(0)) and time.monotonic() < end:
            pass
        return ready
