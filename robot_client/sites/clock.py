"""The offloader's time: what it reads, and how it waits. Simulations have a clock of their own."""

import contextlib
import threading
import time
from collections.abc import Sequence
from concurrent import futures
from concurrent.futures import CancelledError, Future
from typing import Any, Protocol

from offboard.robot_client.sites.turns import Answer


class Clock(Protocol):
    """Seconds from any start, never backwards."""

    def now_s(self) -> float: ...

    def wait(self, pending: "Sequence[Future[Any]]", timeout_s: float | None = None) -> None:
        """Return once one of these futures is done, or after `timeout_s`."""


class SystemClock:
    """The time of this host."""

    now_s = staticmethod(time.perf_counter)

    def wait(self, pending: "Sequence[Future[Any]]", timeout_s: float | None = None) -> None:
        if timeout_s is not None:
            timeout_s = min(timeout_s, threading.TIMEOUT_MAX)  # beyond it Python raises OverflowError
        if len(pending) == 1:  # half the work of the general case
            with contextlib.suppress(TimeoutError, CancelledError):
                pending[0].exception(timeout_s)
            return
        for one in pending:
            if isinstance(one, Answer):
                one.leave()
        futures.wait(pending, timeout_s, futures.FIRST_COMPLETED)
