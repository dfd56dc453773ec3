"""CPU time of what runs here: of the cgroup that holds this process's quota, else of this process.

A cgroup without a quota does not count: it may hold a whole desktop session.
"""

import contextlib
import os
import threading
import time
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

SELF = Path("/proc/self")
READ_BYTES_MAX = 4096
UNLIMITED = ("max", "-1")  # in place of a quota
# Where the quota and the CPU time of a group are: controller (version 2 names none) and file.
_VERSIONS = ((("", "cpu.max"), ("", "cpu.stat")), (("cpu", "cpu.cfs_quota_us"), ("cpuacct", "cpuacct.usage")))


def used_s() -> float:
    """CPU seconds used so far; only the difference of two calls means something, and it is never negative.

    What is read is found at the first call: by then the process must be where its quota is.
    """
    global _clock
    clock = _clock
    if clock is None:
        with _lock:
            clock = _clock = _clock or Clock(usage_file(SELF))
    return clock.used_s()


class Clock:
    """CPU seconds from the usage file of a cgroup; of this process without one, or once it cannot be read."""

    def __init__(self, file: Path | None) -> None:
        self._lock = threading.Lock()
        self._file = -1
        self._lead_s = 0.0  # what the group has used beyond this process
        if file is not None:
            with contextlib.suppress(OSError, ValueError):
                self._file = os.open(file, os.O_RDONLY)
                self._lead_s = self._read_s() - time.process_time()

    def used_s(self) -> float:
        with self._lock:
            # Asked for our own time the kernel charges this thread up to now. The group's figure alone is up
            # to a tick (4 ms) behind.
            own_s = time.process_time()
            if self._file >= 0:
                try:
                    # The group's lead over a process in it can only grow; else the process has left the
                    # group, or the counter was set to 0.
                    self._lead_s = max(self._lead_s, self._read_s() - own_s)
                except (OSError, ValueError):
                    self.close()
            return own_s + self._lead_s

    def close(self) -> None:
        """Count the process's own time from now on. Safe to call twice."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1

    def _read_s(self) -> float:
        return parse_usage(os.pread(self._file, READ_BYTES_MAX, 0))


def process_s(pid: int) -> float:
    """CPU seconds of any process; 0 where there is none of this number."""
    try:
        return time.clock_gettime((~pid << 3) | 2)  # the number of its CPU clock
    except OSError:
        return 0.0


def parse_usage(text: bytes) -> float:
    """CPU seconds in `cpu.stat` (version 2, usage_usec first) or `cpuacct.usage` (version 1, nanoseconds)."""
    figure, _, _ = text.removeprefix(b"usage_usec ").partition(b"\n")
    return int(figure) / (1e6 if text.startswith(b"usage_usec ") else 1e9)


def usage_file(proc: Path) -> Path | None:
    """The usage file of the innermost cgroup with a CPU quota around the process at `proc` (/proc/PID)."""
    group = quota_group(proc)
    return group.usage if group else None


def read_small(path: str | Path) -> bytes:
    """A small file of the kernel's: a Python file object costs more than the reading."""
    file = os.open(path, os.O_RDONLY)
    try:
        return os.read(file, READ_BYTES_MAX)
    finally:
        os.close(file)


@dataclass(frozen=True, slots=True)
class QuotaGroup:
    """A cgroup with a CPU quota: its folder, the name of the quota's file there, and the file of its use."""

    folder: Path
    quota: str
    usage: Path | None

    def cpus(self) -> float | None:
        """The quota in CPUs; None where there is none any more."""
        try:
            limit, *period = read_small(f"{self.folder}/{self.quota}").decode().split()
            if limit in UNLIMITED:
                return None
            return int(limit) / int(period[0] if period else read_small(f"{self.folder}/cpu.cfs_period_us"))
        except (OSError, ValueError, IndexError):
            return None


def quota_group(proc: Path) -> QuotaGroup | None:
    """The innermost cgroup with a CPU quota around the process at `proc` (/proc/PID)."""
    try:
        own = _own_groups((proc / "cgroup").read_text())
        folders = _folders((proc / "mountinfo").read_text(), own)
    except (OSError, ValueError):  # a kernel without cgroups
        return None
    for (limiting, quota), (counting, usage) in _VERSIONS:
        # In two hierarchies of version 1 only groups of one path hold the same processes.
        same = own.get(limiting) == own.get(counting)
        counted = folders.get(counting, []) if same else []
        for n, limited in enumerate(folders.get(limiting, [])):
            if _has_quota(limited / quota):
                return QuotaGroup(limited, quota, counted[n] / usage if n < len(counted) else None)
    return None


def _own_groups(text: str) -> dict[str, PurePosixPath]:
    """The process's own group by controller, from /proc/PID/cgroup."""
    lines = (line.split(":", 2) for line in text.splitlines())
    return {name: PurePosixPath(path) for _, names, path in lines for name in names.split(",")}


def _folders(text: str, own: dict[str, PurePosixPath]) -> dict[str, list[Path]]:
    """By controller the folders of the process's own group and those around it, from /proc/PID/mountinfo.

    In a container the mount may show the container's own group only, while the path is the host's.
    """
    found: dict[str, list[Path]] = {}
    for line in text.splitlines():
        mount, _, filesystem = line.partition(" - ")
        root, point = mount.split()[3:5]
        kind, *_, options = filesystem.split()
        for name in {"cgroup": options.split(","), "cgroup2": [""]}.get(kind, []):
            if name in own and own[name].is_relative_to(root):
                groups = [group for group in (own[name], *own[name].parents) if group.is_relative_to(root)]
                found.setdefault(name, [Path(point) / group.relative_to(root) for group in groups])
    return found


def _has_quota(file: Path) -> bool:
    """Whether `cpu.max` or `cpu.cfs_quota_us` sets one."""
    try:
        return file.read_text().split()[0] not in UNLIMITED
    except (OSError, IndexError):
        return False


def _forget() -> None:
    """In a forked process: it may get a quota of its own, and another thread may have held the lock."""
    global _clock, _lock
    if _clock is not None:
        _clock.close()
    _clock, _lock = None, threading.Lock()


_clock: Clock | None = None
_lock = threading.Lock()
os.register_at_fork(after_in_child=_forget)
