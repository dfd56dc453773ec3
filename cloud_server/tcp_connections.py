"""The robots' connections as the kernel sees them: how to end one, and how much of one was not read yet.

libzmq bounds what it reads ahead by whole messages, so that one message without end, or many large ones
faster than they are taken, would take all memory. What it has received is known to the kernel alone.
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

LOOK_S, LOOK_AGAIN_S = 0.1, 0.01  # between two looks at the memory of this process; while it grows
MESSAGES_UNREAD = 2  # of the largest, on one connection
CURVE_BYTES = 33  # around a frame that is encrypted (RFC 26)
SHORT_FRAME = 255  # bytes; a longer one has a longer length (RFC 23)
RECEIVED = struct.Struct("@128xQ")  # tcpi_bytes_received of struct tcp_info, Linux 4.1 on
STATM, STATM_BYTES_MAX = Path("/proc/self/statm"), 256
PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")

log = logging.getLogger("offboard.cloud_server")


@dataclass(slots=True)
class _Seen:
    """A connection when it was first looked at: its other end, bytes that had come, bytes that were read."""

    other_end: Any
    received: int
    read: int


class Backlog:
    """Ends the connections that have sent most beyond what was read of them, where that is too much.

    Too much is MESSAGES_UNREAD times `message_bytes_max` of one connection, or `bytes_max` of all. They are
    looked at when the memory of this process has grown by half a message. Linux alone tells all this.
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
            threading.Thread(target=self._run, name="backlog", daemon=True).start()
        else:
            log.warning("%s is not there: what robots send ahead is not bounded by bytes", STATM)

    def took(self, file: int, sizes: Iterable[int]) -> None:
        """A message of frames of these sizes was read; called by one thread."""
        self._read[file] = self._read.get(file, 0) + sum(self._on_the_wire(size) for size in sizes)

    def close(self) -> None:
        self._closed = True

    def _on_the_wire(self, size: int) -> int:
        size += self._around
        return size + (2 if size <= SHORT_FRAME else 9)

    def _run(self) -> None:
        pause_s = LOOK_S
        while not self._closed:
            time.sleep(pause_s)  # ten times a second: an event that could be waited for costs more
            now = self._resident_bytes()
            grows = now - self._lowest >= self._message_bytes_max // 2
            self._lowest = now if grows else min(self._lowest, now)
            pause_s = LOOK_AGAIN_S if grows else LOOK_S
            if grows:
                self.look()
        os.close(self._statm)

    def _resident_bytes(self) -> int:
        return int(os.pread(self._statm, STATM_BYTES_MAX, 0).split()[1]) * PAGE_BYTES

    def look(self) -> None:
        """Measure every connection, and end those that are too far ahead."""
        unread: dict[int, int] = {}
        for file, whose, received in _connections(self._port):
            seen, read = self._seen.get(file), self._read.get(file, 0)
            if seen is None or seen.other_end != whose:
                self._seen[file] = _Seen(whose, received, read)
            else:
                unread[file] = (received - seen.received) - (read - seen.read)
        for file in self._too_far_ahead(unread):
            self._metrics.cut_off.inc()
            log.warning(
                "cut off %s: %d bytes of it could not be read", self._seen[file].other_end, unread[file]
            )
            end(file, self._seen.pop(file).other_end)

    def _too_far_ahead(self, unread: dict[int, int]) -> Iterator[int]:
        total = sum(each for each in unread.values() if each > 0)
        for file in sorted(unread, key=unread.__getitem__, reverse=True):
            if unread[file] <= MESSAGES_UNREAD * self._message_bytes_max and total <= self._bytes_max:
                return
            total -= unread[file]
            yield file


def other_end(file: int) -> Any:
    """The address that a connection comes from; None where this is no open connection."""
    try:
        with socket.socket(fileno=os.dup(file)) as held:
            return held.getpeername()
    except OSError:
        return None


def end(file: int, expected: Any) -> None:
    """Shut a connection down, if it is still the one from there: libzmq finds its other end gone."""
    # The number may be another file's by now: hold it first, then look whose it is.
    with contextlib.suppress(OSError), socket.socket(fileno=os.dup(file)) as held:
        if held.getpeername() == expected:
            held.shutdown(socket.SHUT_RDWR)


def _connections(port: int) -> Iterator[tuple[int, Any, int]]:
    """File, other end and bytes received of each connection to this port of ours."""
    for path in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):
            if not str(path.readlink()).startswith("socket:"):
                continue
            with socket.socket(fileno=os.dup(int(path.name))) as held:
                if held.family in (socket.AF_INET, socket.AF_INET6) and held.getsockname()[1] == port:
                    info = held.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, RECEIVED.size)
                    if len(info) == RECEIVED.size:
                        yield int(path.name), held.getpeername(), RECEIVED.unpack(info)[0]
