"""One direction of one connection: bytes in from a socket, out to another when the link says so.

When they are due is `link.py`'s business, the two sockets and their connection are `relay.py`'s.
"""

import asyncio
from collections import deque
from collections.abc import Callable
from typing import Protocol

from loadgen.link import LinkConditions, Pipe
from loadgen.truth import Truth


class Owner(Protocol):
    """The connection that a flow belongs to."""

    number: int
    buffer_bytes: int
    truth: Truth | None

    def because(self, how: str) -> None:
        """The connection ends for this reason, unless it had another before."""

    def cut(self) -> None:
        """The last byte that a truncated stream lets through was delivered."""

    def count(self, direction: str, size: int) -> None:
        """So many bytes were delivered."""


class Flow:
    """Takes bytes from the source, gives them to the target when due.

    What is under way is bounded: beyond it the source is not read, and TCP makes the sender wait. In an
    outage nothing is read and nothing delivered. While the target's side hangs all is read and lost. The
    source's end is delivered like bytes, after them.
    """

    def __init__(self, owner: Owner, direction: str, pipe: Pipe) -> None:
        self._owner = owner
        self._direction = direction
        self._pipe = pipe
        self._loop = asyncio.get_running_loop()
        # (due, chunk, its line of the truth); an empty chunk is the end
        self._under_way: deque[tuple[float, bytes, str]] = deque()
        self._under_way_bytes = 0
        self._ended = False
        self._cut = False  # ended by truncation
        self._timer: asyncio.TimerHandle | None = None
        self.swallowed = False  # a hang took something that can never be delivered
        self.writable = True  # the target has room
        self.source: asyncio.Transport | None = None
        self.target: asyncio.Transport | None = None

    def take(self, data: bytes) -> None:
        """Bytes arrived from the source."""
        if self._ended:  # truncated before
            return
        arrived_s = self._loop.time()
        start, size = 0, self._pipe.left(len(data))
        while start < size:
            end = start + self._pipe.chunk_bytes(size - start)
            self._send(arrived_s, data[start:end])
            start = end
        self._truncate()
        self.refresh()

    def end(self) -> None:
        """The source is closed, or closes its half."""
        if not self._ended:
            self._owner.because("client" if self._direction == "up" else "cloud")
            self._ended = True
            self._send(self._loop.time(), b"")
            self.refresh()

    def set_conditions(self, conditions: LinkConditions) -> None:
        self._pipe.conditions = conditions
        if conditions.hang and not conditions.outage:
            self.drop()
        self._truncate()
        self.refresh()

    def refresh(self) -> None:
        """Deliver what is due, set the timer for the next chunk, read the source if there is room."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        now = self._pipe.conditions
        if self.target is not None and not now.outage:
            self._deliver(self.target)
        if self.source is not None and not self.source.is_closing():
            room = self._under_way_bytes < self._owner.buffer_bytes and self.target is not None
            if (room or now.hang) and not now.outage:
                self.source.resume_reading()
            else:
                self.source.pause_reading()

    def drop(self) -> None:
        """Forget what is under way: it will never be delivered."""
        self.swallowed = self.swallowed or bool(self._under_way)
        for _due_s, _chunk, line in self._under_way:
            self._note(line, None)
        self._under_way.clear()
        self._under_way_bytes = 0

    def _send(self, arrived_s: float, chunk: bytes) -> None:
        segment, size = self._pipe.segment, len(chunk)
        due_s = self._pipe.due(arrived_s, size)
        line = ""
        if self._owner.truth is not None:
            number, direction = self._owner.number, self._direction
            line = self._owner.truth.chunk(number, direction, segment, size, arrived_s, due_s, self._pipe)
        self._under_way.append((due_s, chunk, line))
        self._under_way_bytes += size
        if self._pipe.conditions.hang and not self._pipe.conditions.outage:
            self.drop()

    def _truncate(self) -> None:
        if not self._ended and self._pipe.left(1) == 0:
            self._owner.because("truncated")
            self._ended = self._cut = True
            self._send(self._loop.time(), b"")

    def _deliver(self, target: asyncio.Transport) -> None:
        now_s = self._loop.time()
        due = []
        while self.writable and self._under_way and self._under_way[0][0] <= now_s:
            _due_s, chunk, line = self._under_way.popleft()
            due.append(chunk)
            self._note(line, None if target.is_closing() else now_s)
        if data := b"".join(due):
            self._under_way_bytes -= len(data)
            if not target.is_closing():
                self._owner.count(self._direction, len(data))
                target.write(data)
        if due and not due[-1]:
            target.close()
            if self._cut:
                self._owner.cut()
        elif self.writable and self._under_way:
            self._timer = self._loop.call_at(self._under_way[0][0], self.refresh)

    def _note(self, line: str, delivered_s: float | None) -> None:
        if self._owner.truth is not None:
            self._owner.truth.delivered(line, delivered_s)


class Side(asyncio.Protocol):
    """One socket of a connection: what it receives enters `incoming`; `outgoing` is delivered to it.

    TCP_NODELAY is set by asyncio itself.
    """

    def __init__(self, incoming: Flow, outgoing: Flow, on_lost: Callable[["Side"], None]) -> None:
        self._incoming = incoming
        self._outgoing = outgoing
        self._on_lost = on_lost

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._incoming.source = self._outgoing.target = transport
        # Not from here: Python 3.11.2 undoes a pause made inside connection_made, and ignores later ones.
        loop = asyncio.get_running_loop()
        loop.call_soon(self._incoming.refresh)
        loop.call_soon(self._outgoing.refresh)

    def data_received(self, data: bytes) -> None:
        self._incoming.take(data)

    def eof_received(self) -> bool:
        self._incoming.end()
        return True  # asyncio must not close the socket: bytes for it may still be under way

    def pause_writing(self) -> None:
        self._outgoing.writable = False

    def resume_writing(self) -> None:
        self._outgoing.writable = True
        self._outgoing.refresh()

    def connection_lost(self, _error: Exception | None) -> None:
        self._incoming.end()
        self._on_lost(self)
