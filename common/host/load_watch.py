"""Reads the load of this computer in a background thread.

`load` says how load and capacity are measured.
"""

import contextlib
import threading
from collections.abc import Callable

from offboard.common.host.load import EVERY_S, HURRIED_S, Load


class LoadWatch:
    """Reads a `Load` when `latest` is first called, and from then on in a thread of its own.

    A process that asks for its CPU time may have to wait for its quota at that moment. The thread that
    decides where a task runs must therefore not be the one that asks.

    `every_s`: the time between two readings, or EVERY_S if that is longer and nobody called `latest` since
    the reading before. `pause_s`: turns it into the time before the next reading.
    """

    def __init__(
        self, load: Load, every_s: float = EVERY_S, pause_s: Callable[[float], float] = float
    ) -> None:
        self._load = load
        self._every_s = every_s
        self._resting_s = max(every_s, EVERY_S)
        self._pause_s = pause_s
        self._latest = (0.0, 1.0)
        self._asked = False  # since the last reading
        self._closed = threading.Event()
        self._thread: threading.Thread | None = None
        self._starting = threading.Lock()
        self._reading = threading.Lock()

    def latest(self) -> tuple[float, float]:
        """The load and the capacity of the last reading."""
        self._asked = True
        if self._thread is None:
            self._start()
        return self._latest

    def hurry(self) -> None:
        """Read now, in the caller's thread. Does nothing before the first `latest` or during a reading."""
        if self._thread is not None and self._reading.acquire(blocking=False):
            try:
                self._read()
            finally:
                self._reading.release()

    def close(self) -> None:
        self._closed.set()

    def _start(self) -> None:
        with self._starting:
            if self._thread is None and not self._closed.is_set():
                self._read()
                thread = threading.Thread(target=self._run, name="load", daemon=True)
                with contextlib.suppress(RuntimeError):  # no thread is free: the next `latest` tries again
                    thread.start()
                    self._thread = thread

    def _run(self) -> None:
        while not self._closed.wait(self._next_pause_s()):
            with self._reading:
                self._read()

    def _next_pause_s(self) -> float:
        asked, self._asked = self._asked, False
        return self._pause_s(self._every_s if asked else self._resting_s)

    def _read(self) -> None:
        self._latest = (self._load.share(HURRIED_S), self._load.capacity)
