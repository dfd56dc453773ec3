"""CPU time and CPU quota: of the cgroup (version 1 or 2) that limits a process, or else of the process alone.

A cgroup without a quota is not counted: it may hold a whole desktop session.
"""

import contextlib
import os
import threading
import time
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

SELF = Path("/proc/self")
READ_BYTES_MAX = 4096
UNLIMITED = ("max", "-1")  # what the kernel writes if there is no quota
# For each cgroup version: controller and file of the quota, controller and file of the CPU time.
# Version 2 does not name controllers.
_VERSIONS = ((("", "cpu.max"), ("", "cpu.stat")), (("cpu", "cpu.cfs_quota_us"), ("cpuacct", "cpuacct.usage")))


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
    """Reads CPU seconds from the usage file of a cgroup; without it, counts those of this process alone."""

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


@dataclass(frozen=True, slots=True)
class QuotaGroup:
    """A cgroup with a CPU quota: the name of the quota's file in `folder`, and the file with its CPU time."""

    folder: Path
    quota: str
    usage: Path | None

    def cpus(self) -> float | None:
        """The quota in CPUs; None if it was removed."""
        try:
            limit, *period = read_small(f"{self.folder}/{self.quota}").decode().split()
            if limit in UNLIMITED:
                return None
            return int(limit) / int(period[0] if period else read_small(f"{self.folder}/cpu.cfs_period_us"))
        except (OSError, ValueError, IndexError):
            return None


def quota_group(proc: Path) -> QuotaGroup | None:
    """The innermost cgroup with a CPU quota that contains the process at `proc` (/proc/PID)."""
    try:
        lines = (line.split(":", 2) for line in (proc / "cgroup").read_text().splitlines())
        own = {name: PurePosixPath(path) for _, names, path in lines for name in names.split(",")}
        folders = _folders((proc / "mountinfo").read_text(), own)
    except (OSError, ValueError):  # a kernel without cgroups
        return None
    for (limiting, quota), (counting, usage) in _VERSIONS:
        # Two hierarchies of version 1 hold the same processes only where the paths are equal.
        same = own.get(limiting) == own.get(counting)
        counted = folders.get(counting, []) if same else []
        for n, limited in enumerate(folders.get(limiting, [])):
            if _has_quota(limited / quota):
                return QuotaGroup(limited, quota, counted[n] / usage if n < len(counted) else None)
    return None


def usage_file(proc: Path) -> Path | None:
    """The file with the CPU time of `quota_group(proc)`."""
    group = quota_group(proc)
    return group.usage if group else None


def parse_usage(text: bytes) -> float:
    """CPU seconds in `cpu.stat` (version 2, usage_usec first) or `cpuacct.usage` (version 1, nanoseconds)."""
    figure, _, _ = text.removeprefix(b"usage_usec ").partition(b"\n")
    return int(figure) / (1e6 if text.startswith(b"usage_usec ") else 1e9)


def read_small(path: str | Path, bytes_max: int = READ_BYTES_MAX) -> bytes:
    """The content of a small kernel file. Python's file objects would cost more than the read itself."""
    file = os.open(path, os.O_RDONLY)
    try:
        return os.read(file, bytes_max)
    finally:
        os.close(file)


def _folders(text: str, own: dict[str, PurePosixPath]) -> dict[str, list[Path]]:
    """For each controller the folders of the process's own group and its parents, from /proc/PID/mountinfo.

    In a container the mount may show the container's group only, although the path is that of the host.
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
    """True if `cpu.max` or `cpu.cfs_quota_us` sets a quota."""
    try:
        return file.read_text().split()[0] not in UNLIMITED
    except (OSError, IndexError):
        return False


def _forget() -> None:
    """Start anew in a forked process: it may get a quota of its own, and the lock may have been held."""
    global _clock, _lock
    if _clock is not None:
        _clock.close()
    _clock, _lock = None, threading.Lock()


_clock: Clock | None = None
_lock = threading.Lock()
os.register_at_fork(after_in_child=_forget)
