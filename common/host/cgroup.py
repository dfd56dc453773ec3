"""Finds the cgroup (version 1 or 2) whose CPU quota limits a process, and reads its quota and usage.

`cpu_time` and `load` make CPU times and loads of these figures.
"""

import os
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

SELF = Path("/proc/self")
READ_BYTES_MAX = 4096
UNLIMITED = ("max", "-1")  # what the kernel writes if there is no quota
# For each cgroup version: controller and file of the quota, controller and file of the CPU time.
# Version 2 does not name controllers.
_VERSIONS = ((("", "cpu.max"), ("", "cpu.stat")), (("cpu", "cpu.cfs_quota_us"), ("cpuacct", "cpuacct.usage")))


@dataclass(frozen=True, slots=True)
class QuotaGroup:
    """A cgroup with a CPU quota.

    `quota` is the name of the quota's file in `folder`; `usage` is the file with the group's CPU time.
    """

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
        own = _own_groups((proc / "cgroup").read_text())
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


def _own_groups(text: str) -> dict[str, PurePosixPath]:
    """The process's own group for each controller, from /proc/PID/cgroup."""
    lines = (line.split(":", 2) for line in text.splitlines())
    return {name: PurePosixPath(path) for _, names, path in lines for name in names.split(",")}


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
