"""One direction of one connection: reads bytes from one socket, and writes them to the other when due.

When they are due is computed by `link/pipe.py`; the two sockets belong to `connection.py`.
"""

import asyncio
import contextlib
from collections import deque
from typing import Protocol

from offboard.loadgen.relay.link.link import LinkConditions
from offboard.loadgen.relay.link.pipe import Pipe
from offboard.loadgen.relay.tcp.link_record import LinkRecord

READ_BYTES = 256 << 10  # per read and per write; the fastest of 64 KiB to 1 MiB
CHUNKS_MAX = 65_536  # under way in one direction: a chunk of one byte takes the memory of a hundred


class Shared:
    """What all connections of a relay share: their limit, record and counts, and memory to read into.

    - `buffer_bytes`: bytes under way in one direction of one connection.
    - `view`: the memory that all sockets read into, one read after the other.
    """

    def __init__(self, buffer_bytes: int, record: LinkRecord | None) -> None:
        self.buffer_bytes = buffer_bytes
        self.record = record
        self.bytes = {"up": 0, "down": 0}  # delivered
        self.renew()

    def renew(self) -> None:
        """Take new memory, and leave the old memory to asyncio, which still holds it."""
        self.view = memoryview(bytearray(READ_BYTES))


class Owner(Protocol):
    """The connection that a forwarder belongs to."""

    number: int
    shared: Shared

    def because(self, how: str) -> None:
        """The connection ends for this reason, unless it already has one."""

    def close(self) -> None:
        """The last byte before the truncation was delivered."""

    def settle(self) -> None:
        """The source has ended, or nothing more can be delivered to the target."""


class Forwarder:
    """Reads bytes from the source and delivers them to the target when they are due.

    The bytes and the chunks under way are bounded. When they reach the bound, the source is not read, and
    TCP makes the sender wait. In an outage nothing is read and nothing is delivered. While the side of the
    target hangs, everything is read and lost. The end of the source is delivered like bytes, after them.
    """

    def __init__(self, owner: Owner, direction: str, pipe: Pipe) -> None:
        self._owner = owner
        self._shared = owner.shared
        self._direction = direction
        self._pipe = pipe
        self._loop = asyncio.get_running_loop()
        # (due, chunk, its line in the record); an empty chunk is the end
        self._under_way: deque[tuple[float, bytes, str]] = deque()
        self._under_way_bytes = 0
        self._ended = False  # the end was read: it is under way or delivered
        self._cut = False  # ended by truncation
        self._timer: asyncio.TimerHandle | None = None
        self.source_ended = False
        self.done = False  # nothing more will be delivered
        self.swallowed = False  # a hang took bytes, which can never be delivered
        self.writable = True  # the target has room
        self.source: asyncio.Transport | None = None
        self.target: asyncio.Transport | None = None

    def room(self) -> memoryview:
        """The memory to read into, as long as the bytes that may still be under way."""
        return self._shared.view[: max(1, self._shared.buffer_bytes - self._under_way_bytes)]

    def take(self, size: int) -> None:
        """`size` bytes arrived from the source, in `room`."""
        if self._ended:  # by truncation
            return
        arrived_s = self._loop.time()
        data = self._shared.view[: self._pipe.left(size)]
        start = 0
        while start < len(data):
            end = start + self._pipe.chunk_bytes(len(data) - start)
            self._send(arrived_s, data[start:end])
            start = end
        self._truncate()
        self.refresh()

    def end(self) -> None:
        """The source is closed, at least in this direction."""
        self.source_ended = True
        if not self._ended:
            self._owner.because("client" if self._direction == "up" else "cloud")
            self._ended = True
            self._send(self._loop.time(), b"")
            self.refresh()
        self._owner.settle()

    def lose_target(self) -> None:
        """The target is closed: bytes for it are lost when they are due."""
        self.done = self.writable = True
        self.refresh()
        self._owner.settle()

    def set_conditions(self, conditions: LinkConditions) -> None:
        self._pipe.conditions = conditions
        if conditions.swallows:
            self.drop()
        self._truncate()
        self.refresh()

    def refresh(self) -> None:
        """Deliver what is due, set the timer for the next chunk, and read the source if there is room."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        now = self._pipe.conditions
        if self.target is not None and not now.outage:
            self._deliver(self.target)
        if self.source is not None and not self.source.is_closing():
            accepts = not now.outage and self._has_room() and self.target is not None
            if accepts or now.swallows:
                self.source.resume_reading()
            else:
                self.source.pause_reading()

    def drop(self) -> None:
        """Lose all chunks under way."""
        if self._under_way:
            self.swallowed = True
            self.done = self.done or not self._under_way[-1][1]
        for _due_s, _chunk, line in self._under_way:
            self._note(line, None)
        self._under_way.clear()
        self._under_way_bytes = 0

    def _has_room(self) -> bool:
        return self._under_way_bytes < self._shared.buffer_bytes and len(self._under_way) < CHUNKS_MAX

    def _send(self, arrived_s: float, chunk: memoryview | bytes) -> None:
        segment, size = self._pipe.segment, len(chunk)
        due_s = self._pipe.due(arrived_s, size)
        line = ""
        if self._shared.record is not None:
            line = self._shared.record.chunk(
                self._owner.number,
                self._direction,
                self._pipe,
                segment=segment,
                size=size,
                arrived_s=arrived_s,
                due_s=due_s,
            )
        now = self._pipe.conditions
        clear = self.writable and not (self._under_way or now.outage or now.hang)
        if self.target is not None and clear and size and due_s <= arrived_s:
            self._note(line, None if self.target.is_closing() else self._loop.time())
            self._write(self.target, chunk)
            return
        self._under_way.append((due_s, bytes(chunk), line))
        self._under_way_bytes += size
        if now.swallows:
            self.drop()

    def _truncate(self) -> None:
        if not self._ended and self._pipe.left(1) == 0:
            self._owner.because("truncated")
            self._ended = self._cut = True
            self._send(self._loop.time(), b"")

    def _deliver(self, target: asyncio.Transport) -> None:
        now_s = self._loop.time()
        ended = False
        while self.writable and self._under_way and self._under_way[0][0] <= now_s:
            due, size = [], 0
            while self._under_way and self._under_way[0][0] <= now_s and size < READ_BYTES:
                _due_s, chunk, line = self._under_way.popleft()
                due.append(chunk)
                size += len(chunk)
                ended = not chunk
                self._note(line, None if target.is_closing() else now_s)
            self._under_way_bytes -= size
            self._write(target, b"".join(due))
        if ended:
            self._finish(target)
        elif self.writable and self._under_way:
            self._timer = self._loop.call_at(self._under_way[0][0], self.refresh)

    def _write(self, target: asyncio.Transport, data: memoryview | bytes) -> None:
        if not data or target.is_closing():
            return
        self._shared.bytes[self._direction] += len(data)
        target.write(data)
        # asyncio keeps the bytes that the socket did not take; since Python 3.12 it does not copy them.
        if isinstance(data, memoryview) and target.get_write_buffer_size():
            self._shared.renew()

    def _finish(self, target: asyncio.Transport) -> None:
        self.done = True
        if self._cut:
            self._owner.close()
        else:
            with contextlib.suppress(OSError):  # the target is reset, and asyncio does not know it yet
                target.write_eof()
            self._owner.settle()

    def _note(self, line: str, delivered_s: float | None) -> None:
        if self._shared.record is not None:
            self._shared.record.delivered(line, delivered_s)
