"""Who made something that can outlive its maker, and whether that process is gone."""

import socket
from pathlib import Path


def owner(pid: int) -> str:
    """A process for good, also among those of other machines: host, process namespace, number, start."""
    return f"{_host()}/{pid}/{started(pid)}"


def is_gone(name: str) -> bool:
    """Whether the process of this name is known to be gone; of another host's that cannot be known."""
    host, pid, _ = name.rsplit("/", 2)
    return host == _host() and name != owner(int(pid))


def started(pid: int) -> int | None:
    """When it started, in the kernel's ticks since boot; None where there is no such process."""
    try:
        return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19])
    except OSError:
        return None


def _host() -> str:
    return f"{socket.gethostname()}/{Path('/proc/self/ns/pid').readlink()}"
