"""What the CPU can do now, and how much of it other programs take: features of the times of tasks.

In a container, or wherever else a CPU quota holds, the CPU is the quota: what others of the group use is
missing to this process, and so is the time that all of them are throttled for.
"""

import contextlib
import os
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path

from offboard.common.host.cpu import QuotaGroup, parse_usage, quota_group, read_small

LOADED = 0.3  # of the CPU, taken by others: from there on times tell of that
EVERY_S = 0.5  # by a robot, and no more often: a reading costs more than a decision
SERVER_EVERY_S = 0.1  # by a server, for all of its robots
HURRIED_S = 0.05  # but so often where it may just have changed
TELLING_S = 0.02  # CPU seconds there were to take; of fewer one sees the kernel's ticks alone
READINGS_MAX = 8  # remembered, to look back as far
LOOKED_UP_EVERY = 8  # readings: how often it is looked up whether there is a quota, and how clocks are held
FREE_MIN = 0.1  # of the CPU: where this process leaves less to others, what they take says nothing
PROCESSES_MAX = 64  # of a group whose CPU time is the sum of theirs
CLOCKS = Path("/sys/devices/system/cpu/cpufreq")
CLOCKS_MAX = 16  # of them are looked at: CPUs of one kind share one
TICK_S = 1 / os.sysconf("SC_CLK_TCK")


class Load:
    """Reads the CPU time of all that shares the CPU with the process at `proc` (/proc/self).

    `own_s`: CPU seconds of what is not others; None: of this process.
    `capacity`: so much of one CPU at full clock may a thread use, above 0 to 1, by the quota and by how low
    the clock is held, as where it gets hot (cpufreq's scaling_max_freq).
    """

    def __init__(
        self,
        proc: Path,
        root: Path = Path("/proc"),
        clocks: Path = CLOCKS,
        own_s: Callable[[], float] | None = None,
    ) -> None:
        self.capacity = 1.0
        self._ours_s = own_s or time.process_time
        self._proc = proc
        self._root = root
        self._clocks = clocks
        self._clock = 1.0
        self._group: QuotaGroup | None = None
        self._readings = 0
        self._read_at_s = -EVERY_S
        # When, and CPU seconds of others and of our own until then.
        self._read_before: deque[tuple[float, float, float]] = deque(maxlen=READINGS_MAX)
        self._cpus = 0.0
        self._share = 0.0

    def share(self, every_s: float = EVERY_S) -> float:
        """From 0 to 1: what others took of the CPU that this process left; 0 where that cannot be told.

        It is of the time since the last reading, which is at least `every_s` ago, or since one further back
        where that was too little to tell.
        """
        now_s = time.monotonic()
        if now_s - self._read_at_s >= every_s:
            with contextlib.suppress(OSError, ValueError, IndexError):
                self._read(now_s)
        return self._share

    def _read(self, now_s: float) -> None:
        first = self._readings == 0
        if self._readings % LOOKED_UP_EVERY == 0:
            first = self._look_up() or first
        self._readings += 1
        cpus = self._quota() or float(os.cpu_count() or 1)
        self.capacity = self._clock * min(1.0, cpus)
        own_s = self._ours_s()
        others_s = self._total_s() - own_s
        before = self._read_before
        if first or cpus != self._cpus:
            before.clear()
        telling = (one for one in reversed(before) if cpus * (now_s - one[0]) >= TELLING_S)
        since = next(telling, before[0] if before else None)
        before.append((now_s, others_s, own_s))
        self._read_at_s, self._cpus = now_s, cpus
        if since is None:
            return
        then_s, others_then_s, own_then_s = since
        took_s, left_s = others_s - others_then_s, cpus * (now_s - then_s) - (own_s - own_then_s)
        if left_s >= FREE_MIN * cpus * (now_s - then_s):
            self._share = min(1.0, max(0.0, took_s / left_s))

    def _look_up(self) -> bool:
        """Whether the CPU is another group's than before: one whose quota holds is not looked for again."""
        self._clock = _clock(self._clocks)
        if self._quota():
            return False
        before, self._group = self._group, quota_group(self._proc)
        return self._group != before

    def _quota(self) -> float | None:
        return self._group.cpus() if self._group else None

    def _total_s(self) -> float:
        """CPU seconds of all, this process among them."""
        if self._group is None:
            return self._machine_s()
        if self._group.usage is not None:
            return parse_usage(read_small(self._group.usage))
        pids = read_small(f"{self._group.folder}/cgroup.procs").decode().split()
        return sum(self._process_s(pid) for pid in pids[:PROCESSES_MAX])

    def _machine_s(self) -> float:
        """From /proc/stat: all but idling, waiting for disks, and guests, who are users already."""
        user, nice, system, _idle, _wait, *rest = map(
            int, read_small(f"{self._root}/stat").split(b"\n", 1)[0].split()[1:9]
        )
        return TICK_S * (user + nice + system + sum(rest))

    def _process_s(self, pid: str) -> float:
        if pid == str(os.getpid()):
            return time.process_time()  # ticks are too coarse where it is taken away again
        try:
            fields = read_small(f"{self._root}/{pid}/stat").rpartition(b")")[2].split()
        except OSError:  # it has just ended
            return 0.0
        return TICK_S * (int(fields[11]) + int(fields[12]))


class LoadWatch:
    """Reads a load at the first look at it, and from then on every `every_s` in a thread of its own.

    `pause_s` makes of that how long it waits for the next reading.

    A process that asks for its CPU time is charged what it owes, and waits there for its quota: a thread that
    decides must not be the one to ask.
    """

    def __init__(
        self, load: Load, every_s: float = EVERY_S, pause_s: Callable[[float], float] = float
    ) -> None:
        self._load = load
        self._every_s = every_s
        self._pause_s = pause_s
        self._latest = (0.0, 1.0)
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="load", daemon=True)
        self._starting = threading.Lock()
        self._reading = threading.Lock()

    def latest(self) -> tuple[float, float]:
        """The share and the capacity that were read last."""
        if self._thread.ident is None:
            with self._starting:
                if self._thread.ident is None and not self._closed.is_set():
                    self._read()
                    self._thread.start()
        return self._latest

    def hurry(self) -> None:
        """Read it now, in the caller's thread, unless it is being read or has just been."""
        if self._thread.ident is not None and self._reading.acquire(blocking=False):
            try:
                self._read()
            finally:
                self._reading.release()

    def close(self) -> None:
        self._closed.set()

    def _run(self) -> None:
        while not self._closed.wait(self._pause_s(self._every_s)):
            with self._reading:
                self._read()

    def _read(self) -> None:
        self._latest = (self._load.share(HURRIED_S), self._load.capacity)


def _clock(folder: Path) -> float:
    """The highest clock that is allowed over the highest there is; 1 where the kernel does not tell."""
    allowed = full = 0
    with contextlib.suppress(OSError, ValueError):
        for policy in sorted(folder.glob("policy*"))[:CLOCKS_MAX]:
            allowed += int(read_small(policy / "scaling_max_freq"))
            full += int(read_small(policy / "cpuinfo_max_freq"))
    return min(1.0, allowed / full) if allowed > 0 and full > 0 else 1.0
