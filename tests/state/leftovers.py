"""Threads and open files of this process: which ones are new since a moment before."""

import contextlib
import threading
import time
from collections import Counter
from pathlib import Path

SETTLE_S = 10.0  # a run that nobody waits for may go on until its task ends


class Leftovers:
    """Remembers which threads and files there are when it is made."""

    def __init__(self) -> None:
        self._threads = set(threading.enumerate())
        self._files = _files()

    def found(self, within_s: float = SETTLE_S) -> list[str]:
        """What is new and stays, for at most so long."""
        end_s = time.monotonic() + within_s
        while (new := self._new()) and time.monotonic() < end_s:
            time.sleep(0.02)
        known = _connections() if new else {}
        return [known.get(one, one) for one in new]

    def _new(self) -> list[str]:
        threads = [f"thread {one.name}" for one in threading.enumerate() if one not in self._threads]
        return threads + sorted((_files() - self._files).elements())


def _files() -> Counter[str]:
    """What the file descriptors of this process refer to: files, sockets, pipes, event files."""
    found: Counter[str] = Counter()
    for entry in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):  # that of the folder itself
            found[str(entry.readlink())] += 1
    return found


def _connections() -> dict[str, str]:
    """The TCP sockets of this machine by what a file descriptor refers to, with ports and state in hex."""
    lines = Path("/proc/self/net/tcp").read_text().splitlines()[1:]
    found = {}
    for _, here, there, state, *_, inode in (line.split()[:10] for line in lines):
        found[f"socket:[{inode}]"] = f"socket:[{inode}] from {here} to {there}, state {state}"
    return found
