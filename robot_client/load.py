"""How much of the robot's own CPU other programs take: a feature of onboard times.

In a container, or wherever else a CPU quota holds, the CPU is the quota: what others of the group use is
missing to this process, and so is the time that all of them are throttled for.
"""

import contextlib
import os
import threading
import time
from pathlib import Path

from common.cpu import READ_BYTES_MAX, QuotaGroup, parse_usage, quota_group

EVERY_S = 0.5  # read no more often: a reading costs more than a decision
HURRIED_S = 0.05  # but so often where it may just have changed; what a shorter time tells is ticks
QUOTA_EVERY = 8  # readings: how often the quota is looked up again
FREE_MIN = 0.1  # of the CPU: where this process leaves less to others, what they take says nothing
PROCESSES_MAX = 64  # of a group whose CPU time is the sum of theirs
TICK_S = 1 / os.sysconf("SC_CLK_TCK")


class Load:
    """Reads the CPU time of all that shares the CPU with the process at `proc` (/proc/self).

    Everything is found at the first reading: by then the process must be where its quota is.
    """

    def __init__(self, proc: Path, root: Path = Path("/proc")) -> None:
        self._proc = proc
        self._root = root
        self._group: QuotaGroup | None = None
        self._found = False
        self._cpus = 1.0
        self._readings = 0
        self._read_at_s = -EVERY_S
        self._others_s = self._own_s = 0.0
        self._share = 0.0

    def share(self, every_s: float = EVERY_S) -> float:
        """From 0 to 1: what others took of the CPU that this process left; 0 where that cannot be told.

        It is of the time since the last reading, which is at least `every_s` ago.
        """
        now_s = time.monotonic()
        since_s = now_s - self._read_at_s
        if since_s >= every_s:
            with contextlib.suppress(OSError, ValueError, IndexError):
                self._read(now_s, since_s)
        return self._share

    def _read(self, now_s: float, since_s: float) -> None:
        first = not self._found
        if first:
            self._group, self._found = quota_group(self._proc), True
        if self._readings % QUOTA_EVERY == 0:
            self._cpus = (self._group.cpus() if self._group else None) or float(os.cpu_count() or 1)
        self._readings += 1
        cpus = self._cpus
        own_s = time.process_time()
        others_s = self._total_s() - own_s
        took_s, left_s = others_s - self._others_s, cpus * since_s - (own_s - self._own_s)
        self._others_s, self._own_s, self._read_at_s = others_s, own_s, now_s
        if first:
            return
        if left_s >= FREE_MIN * cpus * since_s:
            self._share = min(1.0, max(0.0, took_s / left_s))

    def _total_s(self) -> float:
        """CPU seconds of all, this process among them."""
        if self._group is None:
            return self._machine_s()
        if self._group.usage is not None:
            return parse_usage(_read(self._group.usage))
        pids = _read(f"{self._group.folder}/cgroup.procs").decode().split()
        return sum(self._process_s(pid) for pid in pids[:PROCESSES_MAX])

    def _machine_s(self) -> float:
        """From /proc/stat: all but idling, waiting for disks, and guests, who are users already."""
        user, nice, system, _idle, _wait, *rest = map(
            int, _read(f"{self._root}/stat").split(b"\n", 1)[0].split()[1:9]
        )
        return TICK_S * (user + nice + system + sum(rest))

    def _process_s(self, pid: str) -> float:
        if pid == str(os.getpid()):
            return time.process_time()  # ticks are too coarse where it is taken away again
        try:
            fields = _read(f"{self._root}/{pid}/stat").rpartition(b")")[2].split()
        except OSError:  # it has just ended
            return 0.0
        return TICK_S * (int(fields[11]) + int(fields[12]))


class LoadWatch:
    """Reads a load every EVERY_S in a thread of its own, from the first look at it on.

    A process that asks for its CPU time is charged what it owes, and waits there for its quota: a thread that
    decides must not be the one to ask.
    """

    def __init__(self, load: Load) -> None:
        self._load = load
        self._share = 0.0
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="load", daemon=True)
        self._starting = threading.Lock()
        self._reading = threading.Lock()

    def latest(self) -> float:
        """The share that was read last."""
        if self._thread.ident is None:
            with self._starting:
                if self._thread.ident is None and not self._closed.is_set():
                    self._thread.start()
        return self._share

    def hurry(self) -> None:
        """Read it now, in the caller's thread, unless it is being read or has just been."""
        if self._thread.ident is not None and self._reading.acquire(blocking=False):
            try:
                self._share = self._load.share(HURRIED_S)
            finally:
                self._reading.release()

    def close(self) -> None:
        self._closed.set()

    def _run(self) -> None:
        while True:
            with self._reading:
                self._share = self._load.share(HURRIED_S)
            if self._closed.wait(EVERY_S):
                return


def _read(path: str | Path) -> bytes:
    """A small file of the kernel's: a Python file object costs more than the reading."""
    file = os.open(path, os.O_RDONLY)
    try:
        return os.read(file, READ_BYTES_MAX)
    finally:
        os.close(file)
