"""Measures the load and the capacity of the CPU: features from which the times of tasks are predicted.

"The CPU" means the CPUs that this process may use (`taskset`, cpusets). If a CPU quota limits the process, as
in a container, it means the quota: other processes of the group use it up as well, and all of them wait while
the group is throttled.
"""

import contextlib
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Set
from pathlib import Path

from offboard.common.cpu_time import QuotaGroup, parse_usage, quota_group, read_small

LOADED = 0.3  # load from which a computer counts as loaded
EVERY_S = 0.5  # between two readings on a robot: a reading costs more than a decision
SERVER_EVERY_S = 0.1  # between two readings on a server, which serves many robots
HURRIED_S = 0.05  # between two readings at a moment when the load may just have changed
TELLING_S = 0.02  # CPU seconds between two readings: with fewer, the kernel's ticks hide the load
READINGS_MAX = 8  # readings kept, to look back that far
LOOKED_UP_EVERY = 8  # readings between two look-ups of the quota and of the clock frequency
FREE_MIN = 0.1  # share of the CPU: if this process leaves less to others, their share means nothing
PROCESSES_MAX = 64  # of a group whose CPU time is summed over its processes
CLOCKS = Path("/sys/devices/system/cpu/cpufreq")
CLOCKS_MAX = 16  # clocks that are looked at: CPUs of the same type share one
CPU_LINE_BYTES = 256  # of /proc/stat, at most
TICK_S = 1 / os.sysconf("SC_CLK_TCK")


class Load:
    """Measures the CPU time of everything that shares the CPU with one process.

    `capacity` says how much of one CPU at full clock one thread may use: above 0, at most 1. A quota lowers
    it, and so does a clock limit (cpufreq's scaling_max_freq), for example because the CPU is hot.

    Parameters: `proc` is the /proc folder of that process, `root` is /proc itself, `clocks` is the folder of
    cpufreq. `own_s` returns the CPU seconds that do not count as load; by default those of this process.
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
        # Time of a reading, and the CPU seconds of others and of our own until then.
        self._read_before: deque[tuple[float, float, float]] = deque(maxlen=READINGS_MAX)
        self._cpus = 0.0
        self._allowed: set[int] = set()  # the numbers of the CPUs that this process may use
        self._share = 0.0

    def share(self, every_s: float = EVERY_S) -> float:
        """The load, 0 to 1: the share that others took of the CPU that this process left; 0 if unknown.

        It covers the time since the last reading, which is at least `every_s` ago. If that time is too short
        to measure a load, it covers the time since an older reading.
        """
        now_s = time.monotonic()
        if now_s - self._read_at_s >= every_s:
            # AttributeError: systems other than Linux report no CPUs that a process may use.
            with contextlib.suppress(OSError, ValueError, IndexError, AttributeError):
                self._read(now_s)
        return self._share

    def _read(self, now_s: float) -> None:
        first = self._readings == 0
        if self._readings % LOOKED_UP_EVERY == 0:
            first = self._look_up() or first
        self._readings += 1
        allowed = os.sched_getaffinity(os.getpid())
        cpus = self._quota() or float(len(allowed))
        self.capacity = self._clock * min(1.0, cpus)
        own_s = self._ours_s()
        others_s = self._total_s(allowed) - own_s
        before = self._read_before
        if first or cpus != self._cpus or allowed != self._allowed:
            before.clear()
        telling = (one for one in reversed(before) if cpus * (now_s - one[0]) >= TELLING_S)
        since = next(telling, before[0] if before else None)
        before.append((now_s, others_s, own_s))
        self._read_at_s, self._cpus, self._allowed = now_s, cpus, allowed
        if since is None:
            return
        then_s, others_then_s, own_then_s = since
        took_s, left_s = others_s - others_then_s, cpus * (now_s - then_s) - (own_s - own_then_s)
        if left_s >= FREE_MIN * cpus * (now_s - then_s):
            self._share = min(1.0, max(0.0, took_s / left_s))

    def _look_up(self) -> bool:
        """Look up clock and quota. True if another group's quota holds now.

        As long as the known group has a quota, no other group is searched for.
        """
        self._clock = _clock(self._clocks)
        if self._quota():
            return False
        before, self._group = self._group, quota_group(self._proc)
        return self._group != before

    def _quota(self) -> float | None:
        return self._group.cpus() if self._group else None

    def _total_s(self, allowed: Set[int]) -> float:
        """CPU seconds of all processes on these CPUs or in the quota's group, this process included."""
        if self._group is None:
            return self._machine_s(allowed)
        if self._group.usage is not None:
            return parse_usage(read_small(self._group.usage))
        pids = read_small(f"{self._group.folder}/cgroup.procs").decode().split()
        return sum(self._process_s(pid) for pid in pids[:PROCESSES_MAX])

    def _machine_s(self, allowed: Set[int]) -> float:
        """From /proc/stat, whose first line counts all CPUs, and each further line one of them."""
        file, all_cpus = f"{self._root}/stat", len(allowed) >= (os.cpu_count() or 1)
        names = {b"cpu"} if all_cpus else {b"cpu%d" % number for number in allowed}
        lines = read_small(file, CPU_LINE_BYTES * (max(allowed) + 2)).split(b"\n")
        return TICK_S * sum(_busy_ticks(line) for line in lines if line.partition(b" ")[0] in names)

    def _process_s(self, pid: str) -> float:
        if pid == str(os.getpid()):
            return time.process_time()  # this time is subtracted again: ticks are too coarse
        try:
            fields = read_small(f"{self._root}/{pid}/stat").rpartition(b")")[2].split()
        except OSError:  # the process has just ended
            return 0.0
        return TICK_S * (int(fields[11]) + int(fields[12]))


def _busy_ticks(line: bytes) -> int:
    """From a line of /proc/stat, without idle time, waits for disks, and guests (the user time has them)."""
    user, nice, system, _idle, _wait, *rest = map(int, line.split()[1:9])
    return user + nice + system + sum(rest)


def _clock(folder: Path) -> float:
    """The highest clock allowed divided by the highest possible; 1 if the kernel does not report them."""
    allowed = full = 0
    with contextlib.suppress(OSError, ValueError):
        for policy in sorted(folder.glob("policy*"))[:CLOCKS_MAX]:
            allowed += int(read_small(policy / "scaling_max_freq"))
            full += int(read_small(policy / "cpuinfo_max_freq"))
    return min(1.0, allowed / full) if allowed > 0 and full > 0 else 1.0


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
