"""One connection of the relay: a socket to the client, a socket to the cloud, and two forwarders.

The bytes are moved by `forwarder.py`; `relay.py` accepts connections and owns the link.
"""

import asyncio
import select
import socket
import struct
from typing import Protocol

from offboard.loadgen.relay.link.link import Link
from offboard.loadgen.relay.link.pipe import Pipe
from offboard.loadgen.relay.tcp.forwarder import Forwarder, Shared

CONNECT_S = 5.0
RST_AT_CLOSE = struct.pack("ii", 1, 0)  # SO_LINGER: on, 0 seconds


class RelayOfConnections(Protocol):
    """The relay, as far as its connections use it."""

    target: tuple[str, int]
    link: Link
    seed: int
    shared: Shared
    connections: "set[Connection]"

    def target_up(self) -> None:
        """The cloud accepted a connection."""

    def target_down(self, error: OSError) -> None:
        """The cloud accepted no connection."""


class Connection:
    """The socket of a client, the socket to the cloud, and the two forwarders between them.

    - One side closes its half: its bytes are still delivered, then the end. When both ends were delivered,
      both sockets are closed.
    - The cloud refuses the connection: the client is disconnected at once.
    - There is an outage, or the cloud hangs: the client is accepted and receives nothing.
    """

    def __init__(self, relay: RelayOfConnections, number: int) -> None:
        self._relay = relay
        self.number = number
        self.shared = relay.shared
        self._loop = asyncio.get_running_loop()
        self._how = ""
        self._aborted = self._by_rst = self._over = False
        if self.shared.record is not None:
            self.shared.record.opened(self._loop.time(), number)
        self._up = Forwarder(self, "up", Pipe(relay.link.up, relay.seed, number, "up"))
        self._down = Forwarder(self, "down", Pipe(relay.link.down, relay.seed, number, "down"))
        self._passable = asyncio.Event()
        self.client = Side(self, self._up, self._down)
        self._open_sides = {self.client}
        self._reset_from_s = dict.fromkeys(("up", "down"), self._loop.time())
        self._reset_timer: asyncio.TimerHandle | None = None
        self._link = relay.link
        self.set_link(relay.link)
        self._opening = self._loop.create_task(self._open())

    def set_link(self, link: Link) -> None:
        before, self._link = self._link, link
        if link.connects:
            self._passable.set()
        else:
            self._passable.clear()
        for forwarder, now in ((self._up, link.up), (self._down, link.down)):
            forwarder.set_conditions(now)
            if forwarder.swallowed and not now.hang:  # bytes are missing, so the rest must not arrive
                self.reset("hang")
        self.settle()
        for direction in ("up", "down"):
            if getattr(link, direction).reset_after_ms != getattr(before, direction).reset_after_ms:
                self._reset_from_s[direction] = self._loop.time()
        self._await_reset()

    @property
    def left(self) -> bool:
        """Whether the client has closed at least its half, and none of its bytes can reach the cloud now."""
        if self._up.done:
            return self._up.source_ended
        held = self._link.up.outage or (self._link.down.outage and self._up.target is None)
        return held and self._up.source is not None and _peer_closed(self._up.source)

    def abort(self, how: str = "closed") -> None:
        """Close both sockets now; a socket that is not open yet is closed when it opens."""
        self.because(how)
        self._aborted = True
        for transport in (self._up.source, self._up.target):
            if transport is not None:
                if self._by_rst and not transport.is_closing():
                    connected = transport.get_extra_info("socket")
                    connected.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RST_AT_CLOSE)
                transport.abort()

    def reset(self, how: str = "reset") -> None:
        """Close both sockets by RST now; a socket that is not open yet is closed when it opens."""
        self._by_rst = True
        self.abort(how)

    def because(self, how: str) -> None:
        """Keep the reason why the connection ends; the first reason counts."""
        self._how = self._how or how

    def close(self) -> None:
        """Close both sockets, after the bytes that were delivered to them."""
        for transport in (self._up.source, self._up.target):
            if transport is not None:
                transport.close()

    def settle(self) -> None:
        """End the connection when both forwarders are done, or when a client that lost bytes has left.

        A client that stays is reset when the hang ends, and receives nothing until then.
        """
        over = self._up.done and self._down.done
        if not (self._up.swallowed or self._down.swallowed):
            if over:
                self.close()
        elif self._up.source_ended and (self._up.swallowed or over):
            self.reset("hang")

    def made(self, side: "Side") -> None:
        """A socket of the connection is open."""
        self._open_sides.add(side)
        # Later, because Python 3.11.2 undoes a pause made inside connection_made, and ignores later pauses.
        self._loop.call_soon(self._begin)

    def lost(self, side: "Side") -> None:
        """A socket of the connection is closed."""
        self._opening.cancel()
        self._open_sides.discard(side)
        if not self._open_sides and not self._over:
            self._end()

    def _begin(self) -> None:
        if self._aborted:
            self.abort()
        self._up.refresh()
        self._down.refresh()

    def _await_reset(self) -> None:
        """Reset the connection when it is time, and not before the end of an outage."""
        if self._reset_timer is not None:
            self._reset_timer.cancel()
            self._reset_timer = None
        times_s = [
            self._reset_from_s[direction] + getattr(self._link, direction).reset_after_ms / 1e3
            for direction in ("up", "down")
            if getattr(self._link, direction).reset_after_ms
        ]
        if not times_s or not self._link.resets:
            return
        if min(times_s) <= self._loop.time():
            self.reset()
        else:
            self._reset_timer = self._loop.call_at(min(times_s), self._await_reset)

    async def _open(self) -> None:
        await self._passable.wait()
        cloud = Side(self, self._down, self._up)
        try:
            opening = self._loop.create_connection(lambda: cloud, *self._relay.target)
            await asyncio.wait_for(opening, CONNECT_S)
            self._relay.target_up()
        except (OSError, asyncio.TimeoutError) as error:  # in Python 3.10, the second is no OSError
            self._relay.target_down(error)
            self.abort("refused")

    def _end(self) -> None:
        self._over = self._aborted = True  # a socket to the cloud that opens now is closed at once
        self._relay.connections.discard(self)
        if self._reset_timer is not None:
            self._reset_timer.cancel()
        if self.shared.record is not None:
            self._up.drop()
            self._down.drop()
            self.shared.record.closed(self._loop.time(), self.number, self._how)


class Side(asyncio.BufferedProtocol):
    """One socket of a connection: `incoming` forwards what it receives, `outgoing` delivers to it."""

    def __init__(self, connection: Connection, incoming: Forwarder, outgoing: Forwarder) -> None:
        self._connection = connection
        self._incoming = incoming
        self._outgoing = outgoing

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        # asyncio sets TCP_NODELAY only on sockets that were created with the number of the protocol.
        transport.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._incoming.source = self._outgoing.target = transport
        self._connection.made(self)

    def get_buffer(self, _sizehint: int) -> memoryview:
        return self._incoming.room()

    def buffer_updated(self, nbytes: int) -> None:
        self._incoming.take(nbytes)

    def eof_received(self) -> bool:
        self._incoming.end()
        return True  # asyncio must not close the socket: bytes to it may still be under way

    def pause_writing(self) -> None:
        self._outgoing.writable = False

    def resume_writing(self) -> None:
        self._outgoing.writable = True
        self._outgoing.refresh()

    def connection_lost(self, _error: Exception | None) -> None:
        self._incoming.end()
        self._outgoing.lose_target()
        self._connection.lost(self)


def _peer_closed(transport: asyncio.Transport) -> bool:
    """Whether the peer has closed, even if bytes before its end were not read."""
    if transport.is_closing():
        return True
    poll = select.poll()
    poll.register(transport.get_extra_info("socket"), select.POLLRDHUP)
    return bool(poll.poll(0))
