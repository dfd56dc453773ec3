"""Names a process, and says whether it is gone, so that what it left behind can be removed."""

import socket
from pathlib import Path


def owner(pid: int) -> str:
    """A name that no other process ever has, on any machine: host, process namespace, pid and start time."""
    return f"{_host()}/{pid}/{started(pid)}"


def is_gone(name: str) -> bool:
    """Whether the process with this name is known to be gone; False for a process of another host."""
    host, pid, _ = name.rsplit("/", 2)
    return host == _host() and name != owner(int(pid))


def started(pid: int) -> int | None:
    """The start time of a process, in kernel ticks since boot; None if there is no such process."""
    try:
        return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19])
    except OSError:
        return None


def _host() -> str:
    return f"{socket.gethostname()}/{Path('/proc/self/ns/pid').readlink()}"
