"""The relay's sockets: ordinary TCP connections, the link's conditions put on their bytes.

Works in user space, without root or kernel modules. What a link does is `link.py`; who starts the relay and
changes its link is `wan.py`. The TCP handshake itself is not delayed, only the bytes.
"""

import asyncio
import logging
import select
import selectors
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from loadgen.link import SEGMENT_BYTES, Link, LinkConditions, Pipe

CHUNK_BYTES = 8 * SEGMENT_BYTES  # a long read is cut, so that its first bytes do not wait for its last
CONNECT_S = 5.0
SPIN_S = 0.0003

log = logging.getLogger(__name__)


class Relay:
    """Accepts connections, opens one to `target` (host, port) for each, and keeps the link they all share.

    At most `connections_max` at a time, and `buffer_bytes` under way in one direction of one of them.
    """

    def __init__(
        self, target: tuple[str, int], link: Link, *, seed: int, connections_max: int, buffer_bytes: int
    ) -> None:
        self.target = target
        self.link = link
        self.seed = seed
        self.buffer_bytes = buffer_bytes
        self._connections_max = connections_max
        self._target_is_up = True
        self.connections: set[Connection] = set()  # bounded by connections_max
        self.accepted = 0
        self.refused = 0
        self.bytes = {"up": 0, "down": 0}

    def set_link(self, link: Link) -> None:
        """Put new conditions on all bytes that arrive from now on."""
        self.link = link
        for connection in tuple(self.connections):
            connection.set_link(link)

    def accept(self) -> asyncio.Protocol:
        """The protocol of a client's socket that was just accepted."""
        if len(self.connections) >= self._connections_max:
            self.refused += 1
            return Refusal()
        self.accepted += 1
        connection = Connection(self, self.accepted)
        self.connections.add(connection)
        return connection.client

    def target_up(self) -> None:
        self._target_is_up = True

    def target_down(self, error: OSError) -> None:
        """Say once that connections are closed because the cloud takes none."""
        if self._target_is_up:
            log.warning("cannot connect to %s:%d: %s", *self.target, error)
        self._target_is_up = False

    def abort(self) -> None:
        """Close every connection now."""
        for connection in tuple(self.connections):
            connection.abort()

    def status(self) -> dict[str, Any]:
        """Connections and bytes delivered, for the control API."""
        counts = {"connections": len(self.connections), "accepted": self.accepted, "refused": self.refused}
        return counts | {f"bytes_{direction}": count for direction, count in self.bytes.items()}


class Flow:
    """One direction of one connection: takes bytes from the source, gives them to the target when due.

    What is under way is bounded: beyond it the source is not read, and TCP makes the sender wait. In an
    outage nothing is read and nothing delivered. The source's end is delivered like bytes, after them.
    """

    def __init__(self, relay: Relay, number: int, direction: str) -> None:
        self._relay = relay
        self._direction = direction
        self._pipe = Pipe(getattr(relay.link, direction), relay.seed, number, direction)
        self._loop = asyncio.get_running_loop()
        self._under_way: deque[tuple[float, bytes]] = deque()  # (due, chunk); an empty chunk is the end
        self._under_way_bytes = 0
        self._ended = False
        self._timer: asyncio.TimerHandle | None = None
        self.writable = True  # the target has room
        self.source: asyncio.Transport | None = None
        self.target: asyncio.Transport | None = None

    def take(self, data: bytes) -> None:
        """Bytes arrived from the source."""
        arrived_s = self._loop.time()
        for start in range(0, len(data), CHUNK_BYTES):
            chunk = data[start : start + CHUNK_BYTES]
            self._under_way.append((self._pipe.due(arrived_s, len(chunk)), chunk))
        self._under_way_bytes += len(data)
        self.refresh()

    def end(self) -> None:
        """The source is closed, or closes its half."""
        if not self._ended:
            self._ended = True
            self._under_way.append((self._pipe.due(self._loop.time(), 0), b""))
            self.refresh()

    def set_conditions(self, conditions: LinkConditions) -> None:
        self._pipe.conditions = conditions
        self.refresh()

    def refresh(self) -> None:
        """Deliver what is due, set the timer for the next chunk, read the source if there is room."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self.target is not None and not self._pipe.conditions.outage:
            self._deliver(self.target)
        if self.source is not None and not self.source.is_closing():
            room = self._under_way_bytes < self._relay.buffer_bytes
            if room and self.target is not None and not self._pipe.conditions.outage:
                self.source.resume_reading()
            else:
                self.source.pause_reading()

    def _deliver(self, target: asyncio.Transport) -> None:
        now_s = self._loop.time()
        due = []
        while self.writable and self._under_way and self._under_way[0][0] <= now_s:
            due.append(self._under_way.popleft()[1])
        if data := b"".join(due):
            self._under_way_bytes -= len(data)
            if not target.is_closing():
                self._relay.bytes[self._direction] += len(data)
                target.write(data)
        if due and not due[-1]:
            target.close()
        elif self.writable and self._under_way:
            self._timer = self._loop.call_at(self._under_way[0][0], self.refresh)


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


class Connection:
    """A client's socket, the one to the cloud that belongs to it, and the two flows between them.

    When one side closes, what it had sent is still delivered, then the other side is closed. When the
    cloud refuses, the client is closed at once. In an outage the client is accepted and hears nothing.
    """

    def __init__(self, relay: Relay, number: int) -> None:
        self._relay = relay
        self._up = Flow(relay, number, "up")
        self._down = Flow(relay, number, "down")
        self._passable = asyncio.Event()
        self.client = Side(self._up, self._down, self._lost)
        self._open_sides = {self.client}
        self.set_link(relay.link)
        self._opening = asyncio.get_running_loop().create_task(self._open())

    def set_link(self, link: Link) -> None:
        if link.up.outage or link.down.outage:
            self._passable.clear()
        else:
            self._passable.set()
        self._up.set_conditions(link.up)
        self._down.set_conditions(link.down)

    def abort(self) -> None:
        """Close both sockets now."""
        for transport in (self._up.source, self._up.target):
            if transport is not None:
                transport.abort()

    async def _open(self) -> None:
        await self._passable.wait()
        cloud = Side(self._down, self._up, self._lost)
        try:
            async with asyncio.timeout(CONNECT_S):
                await asyncio.get_running_loop().create_connection(lambda: cloud, *self._relay.target)
            self._open_sides.add(cloud)
            self._relay.target_up()
        except OSError as error:  # TimeoutError is one
            self._relay.target_down(error)
            self.abort()

    def _lost(self, side: Side) -> None:
        self._opening.cancel()
        self._open_sides.discard(side)
        if not self._open_sides:
            self._relay.connections.discard(self)


class Refusal(asyncio.Protocol):
    """Closes a connection that is one too many."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        transport.close()


class PreciseSelector(selectors.EpollSelector):
    """Waits to the microsecond: epoll alone rounds every timer up to a whole millisecond.

    A sleeping core is some 0.2 ms late too, so the last SPIN_S of a wait are watched, not slept.
    """

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        if timeout is None or timeout <= 0:
            return super().select(timeout)
        end = time.monotonic() + timeout
        if timeout > SPIN_S:
            select.select([self.fileno()], [], [], timeout - SPIN_S)
        while not (ready := super().select(0)) and time.monotonic() < end:
            pass
        return ready
