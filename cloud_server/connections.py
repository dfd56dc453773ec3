"""The connections of robots: closing one, limiting what was not read yet, and which ones have ended.

libzmq limits what it receives in advance by the number of messages, so one endless message could take all
memory. libzmq also does not say whose connection has ended. Therefore the kernel is asked.
"""

import contextlib
import logging
import os
import socket
import struct
import threading
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from offboard.cloud_server.metrics import Metrics
from offboard.common import VERSION
from offboard.common.source.comparison import other_sources, versions
from offboard.common.tasks import hashes
from offboard.common.wire.messages import Hello

LOOK_S = 0.5  # between two checks of the connections that wait for answers
MEMORY_S, MEMORY_AGAIN_S = 0.1, 0.01  # between two checks of this process's memory: usually, and if it grows
MESSAGES_UNREAD = 2  # messages of the largest size that may be unread on one connection
CURVE_BYTES = 33  # that encryption adds to a frame (RFC 26)
SHORT_FRAME = 255  # bytes; the length of a longer frame takes more bytes (RFC 23)
RECEIVED = struct.Struct("@128xQ")  # tcpi_bytes_received of struct tcp_info, Linux 4.1 on
SILENT_MS = struct.Struct("@52xI")  # tcpi_last_data_recv of it: since the last bytes came
STATM, STATM_BYTES_MAX = Path("/proc/self/statm"), 256
PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")
# A robot that sends heartbeats is never silent for more than 2.4 s. If nothing of it arrives for 15 s, it
# gives the connection up itself, and no longer waits for the answers.
SILENT_S = 20.0
KEPT = 4096  # connections that are remembered
VERSIONS_MAX = 16  # versions of robots that are named; a robot may claim any
NAMES_SHOWN = 5

log = logging.getLogger("offboard.cloud_server")


@dataclass(slots=True)
class _Connection:
    """`file` and `other_end` are known to the kernel. `pings`: its robot sends heartbeats."""

    file: int
    other_end: Any
    pings: bool = False


class Connections:
    """Remembers the connection of each peer. Called under the lock of the channel."""

    def __init__(self) -> None:
        self._known: dict[bytes, _Connection] = {}

    def heard(self, peer: bytes, file: int) -> None:
        known = self._known.get(peer)
        if known is None or known.file != file:
            self._known[peer] = _Connection(file, other_end(file))
            if len(self._known) > KEPT:
                del self._known[next(iter(self._known))]

    def pings(self, peer: bytes) -> None:
        """This peer, which was just heard, sends heartbeats."""
        self._known[peer].pings = True

    def ended(self, peer: bytes) -> bool:
        """Whether the connection has ended. If it was silent for too long, it ends before the next look."""
        known = self._known.get(peer)
        if known is None:
            return False
        if known.other_end is None or other_end(known.file) != known.other_end:
            del self._known[peer]
            return True
        if known.pings and silent_s(known.file, known.other_end) > SILENT_S:
            log.info("closed the connection to %s: nothing came for %g s", known.other_end, SILENT_S)
            end(known.file, known.other_end)
        return False


@dataclass(slots=True)
class _Seen:
    """A connection at its first check: its other end, and the bytes received and read by then."""

    other_end: Any
    received: int
    read: int


class UnreadLimit:
    """Closes the connections with the most unread bytes, if there are too many unread bytes.

    Too many are MESSAGES_UNREAD times `message_bytes_max` on one connection, or `bytes_max` on all of them.
    Connections are checked when the memory of this process has grown by half a message. Works on Linux only.
    """

    def __init__(
        self, port: int, message_bytes_max: int, bytes_max: int, metrics: Metrics, *, encrypted: bool
    ) -> None:
        self._port = port
        self._message_bytes_max, self._bytes_max = message_bytes_max, bytes_max
        self._metrics = metrics
        self._around = CURVE_BYTES if encrypted else 0
        self._read: dict[int, int] = {}
        self._seen: dict[int, _Seen] = {}
        self._closed = False
        if STATM.exists():
            self._statm = os.open(STATM, os.O_RDONLY)
            self._lowest = self._resident_bytes()
            threading.Thread(target=self._run, name="unread-limit", daemon=True).start()
        else:
            text = "%s does not exist: the memory for unread messages is not limited; remedy: mount /proc"
            log.warning(text, STATM)

    def took(self, file: int, sizes: Iterable[int]) -> None:
        """A message with frames of these sizes was read. Called by one thread at a time."""
        sent = [size + self._around for size in sizes]
        self._read[file] = self._read.get(file, 0) + sum([n + (2 if n <= SHORT_FRAME else 9) for n in sent])

    def close(self) -> None:
        self._closed = True

    def _run(self) -> None:
        pause_s = MEMORY_S
        while not self._closed:
            time.sleep(pause_s)  # waiting for an event would cost more
            now = self._resident_bytes()
            grows = now - self._lowest >= self._message_bytes_max // 2
            self._lowest = now if grows else min(self._lowest, now)
            pause_s = MEMORY_AGAIN_S if grows else MEMORY_S
            if grows:
                with contextlib.suppress(OSError):  # no file is free; look again after the pause
                    self.look()
        os.close(self._statm)

    def _resident_bytes(self) -> int:
        return int(os.pread(self._statm, STATM_BYTES_MAX, 0).split()[1]) * PAGE_BYTES

    def look(self) -> None:
        """Check every connection, and close those with too many unread bytes."""
        unread: dict[int, int] = {}
        for file, whose, received in _connections(self._port):
            seen, read = self._seen.get(file), self._read.get(file, 0)
            if seen is None or seen.other_end != whose:
                self._seen[file] = _Seen(whose, received, read)
            else:
                unread[file] = (received - seen.received) - (read - seen.read)
        for file in self._too_many(unread):
            self._metrics.cut_off.inc()
            log.warning(
                "cut off %s: it sent %d bytes more than could be read; "
                "remedy: if it is your robot, raise --message-mib and --blob-mib",
                self._seen[file].other_end,
                unread[file],
            )
            end(file, self._seen.pop(file).other_end)

    def _too_many(self, unread: dict[int, int]) -> Iterator[int]:
        total = sum(each for each in unread.values() if each > 0)
        for file in sorted(unread, key=unread.__getitem__, reverse=True):
            if unread[file] <= MESSAGES_UNREAD * self._message_bytes_max and total <= self._bytes_max:
                return
            total -= unread[file]
            yield file


class OtherVersions:
    """Says once that robots with another version of Offboard keep tasks onboard, because their hashes differ.

    A robot compares hashes by itself, and an old one blames the source of its tasks.
    """

    def __init__(self) -> None:
        self._named: set[str] = set()

    def hear(self, hello: Hello) -> None:
        if hello.software in {VERSION, *self._named} or len(self._named) >= VERSIONS_MAX:
            return
        names = other_sources(hashes(), hello.tasks)
        if not names:
            return
        self._named.add(hello.software)
        more = f" and {len(names) - NAMES_SHOWN} more" if len(names) > NAMES_SHOWN else ""
        text = (
            "a robot keeps %s%s onboard: the source differs%s; "
            "remedy: install the same version of Offboard, and of the tasks, on both sides"
        )
        log.warning(text, ", ".join(names[:NAMES_SHOWN]), more, versions(hello.software))


def other_end(file: int) -> Any:
    """The address at the other end of this connection; None if the file is no open connection."""
    try:
        borrowed = socket.socket(fileno=file)  # not a duplicate: connections may have taken all files
    except OSError:
        return None
    try:
        return borrowed.getpeername()
    except OSError:
        return None
    finally:
        borrowed.detach()


def silent_s(file: int, expected: Any) -> float:
    """The seconds since bytes came from `expected`; 0 if this connection is not to it, or nobody knows."""
    with contextlib.suppress(OSError, AttributeError), socket.socket(fileno=os.dup(file)) as held:
        info = held.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, SILENT_MS.size)
        if held.getpeername() == expected and len(info) == SILENT_MS.size:
            return float(SILENT_MS.unpack(info)[0] / 1e3)
    return 0.0


def end(file: int, expected: Any) -> None:
    """Close this connection if `expected` is at its other end. libzmq sees that the robot is gone."""
    # Another file may have this number by now: duplicate it first, then check whose it is.
    with contextlib.suppress(OSError), socket.socket(fileno=os.dup(file)) as held:
        if held.getpeername() == expected:
            held.shutdown(socket.SHUT_RDWR)


def _connections(port: int) -> Iterator[tuple[int, Any, int]]:
    """For each connection to this port: file, other end, and bytes received."""
    for path in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):
            if not str(path.readlink()).startswith("socket:"):
                continue
            with socket.socket(fileno=os.dup(int(path.name))) as held:
                if held.family in (socket.AF_INET, socket.AF_INET6) and held.getsockname()[1] == port:
                    info = held.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, RECEIVED.size)
                    if len(info) == RECEIVED.size:
                        yield int(path.name), held.getpeername(), RECEIVED.unpack(info)[0]
