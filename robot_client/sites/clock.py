"""The clock of the offloader: how it reads the time, and how it waits.

Simulations have a clock of their own.
"""

import contextlib
import threading
import time
from collections.abc import Sequence
from concurrent import futures
from concurrent.futures import CancelledError, Future
from typing import Any, Protocol

from offboard.robot_client.sites.shared_reader import Answer


class Clock(Protocol):
    """Seconds since an arbitrary start; they never go backwards."""

    def now_s(self) -> float: ...

    def wait(self, pending: "Sequence[Future[Any]]", timeout_s: float | None = None) -> None:
        """Return as soon as one of these futures is done, or after `timeout_s`."""


class SystemClock:
    """The clock of this host."""

    now_s = staticmethod(time.perf_counter)

    def wait(self, pending: "Sequence[Future[Any]]", timeout_s: float | None = None) -> None:
        if timeout_s is not None:
            timeout_s = min(timeout_s, threading.TIMEOUT_MAX)  # a longer one raises OverflowError
        if len(pending) == 1:  # takes half as long as the general case
            with contextlib.suppress(TimeoutError, CancelledError):
                pending[0].exception(timeout_s)
            return
        for future in pending:
            if isinstance(future, Answer):
                future.leave_to_thread()
        futures.wait(pending, timeout_s, futures.FIRST_COMPLETED)
