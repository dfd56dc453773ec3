"""Counts the CPU time that is used here: by the cgroup with the CPU quota, or else by this process.

`cgroup` finds that cgroup. A cgroup without a quota is not counted: it may hold a whole desktop session.
"""

import contextlib
import os
import threading
import time
from pathlib import Path

from offboard.common.host.cgroup import READ_BYTES_MAX, SELF, parse_usage, usage_file


def used_s() -> float:
    """CPU seconds used so far. Only the difference of two calls has a meaning; it is never negative.

    The first call looks for the cgroup, so the process must be in its cgroup by then.
    """
    global _clock
    clock = _clock
    if clock is None:
        with _lock:
            clock = _clock = _clock or Clock(usage_file(SELF))
    return clock.used_s()


class Clock:
    """Reads CPU seconds from the usage file of a cgroup.

    Without a file, or after a read failed, it counts the CPU time of this process alone.
    """

    def __init__(self, file: Path | None) -> None:
        self._lock = threading.Lock()
        self._file = -1
        self._lead_s = 0.0  # CPU seconds of the group minus those of this process
        if file is not None:
            with contextlib.suppress(OSError, ValueError):
                self._file = os.open(file, os.O_RDONLY)
                self._lead_s = self._read_s() - time.process_time()

    def used_s(self) -> float:
        with self._lock:
            # Asking for the time of this process makes the kernel charge this thread up to now.
            # The figure of the group alone can be one tick (4 ms) behind.
            own_s = time.process_time()
            if self._file >= 0:
                try:
                    # The group contains this process, so its lead can only grow. A smaller lead means
                    # that the process has left the group, or that the counter was set to 0.
                    self._lead_s = max(self._lead_s, self._read_s() - own_s)
                except (OSError, ValueError):
                    self.close()
            return own_s + self._lead_s

    def close(self) -> None:
        """From now on count the CPU time of this process alone. Safe to call twice."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1

    def _read_s(self) -> float:
        return parse_usage(os.pread(self._file, READ_BYTES_MAX, 0))


def process_s(pid: int) -> float:
    """CPU seconds of the process `pid`; 0 if there is no such process."""
    try:
        return time.clock_gettime((~pid << 3) | 2)  # the kernel's number for the CPU clock of a process
    except OSError:
        return 0.0


def _forget() -> None:
    """Start anew in a forked process.

    The child may get a quota of its own, and another thread of the parent may have held the lock.
    """
    global _clock, _lock
    if _clock is not None:
        _clock.close()
    _clock, _lock = None, threading.Lock()


_clock: Clock | None = None
_lock = threading.Lock()
os.register_at_fork(after_in_child=_forget)
