"""The relay's connections: ordinary TCP, the link's conditions put on their bytes.

Works in user space, without root or kernel modules. What a link does is `link.py`, one direction of one
connection is `flow.py`; who starts the relay and changes its link is `wan.py`. The TCP handshake itself is
not delayed, only the bytes.
"""

import asyncio
import contextlib
import logging
import select
import selectors
import socket
import struct
import time
from typing import Any

from loadgen.flow import Flow, Side
from loadgen.link import Link, Pipe
from loadgen.truth import Truth

CONNECT_S = 5.0
SPIN_S = 0.0003
RST_AT_CLOSE = struct.pack("ii", 1, 0)  # SO_LINGER on, of no seconds

log = logging.getLogger(__name__)


class Relay:
    """Accepts connections, opens one to `target` (host, port) for each, and keeps the link they all share.

    At most `connections_max` at a time, and `buffer_bytes` under way in one direction of one of them.
    What happens is told to `truth`.
    """

    def __init__(
        self,
        target: tuple[str, int],
        link: Link,
        *,
        seed: int,
        connections_max: int,
        buffer_bytes: int,
        truth: Truth | None = None,
    ) -> None:
        self.target = target
        self.link = link
        self.seed = seed
        self.buffer_bytes = buffer_bytes
        self.truth = truth
        self._connections_max = connections_max
        self._target_is_up = True
        self.connections: set[Connection] = set()  # bounded by connections_max
        self.accepted = 0
        self.refused = 0
        self.bytes = {"up": 0, "down": 0}
        if truth is not None:
            truth.conditions(asyncio.get_running_loop().time(), "flag", link)

    def set_link(self, link: Link, by: str = "http") -> None:
        """Put new conditions on all bytes that arrive from now on."""
        self.link = link
        if self.truth is not None:
            self.truth.conditions(asyncio.get_running_loop().time(), by, link)
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
            connection.abort("stopped")

    async def ended(self, within_s: float) -> None:
        """Return when no connection is left, or after this long."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(within_s):
                while self.connections:
                    await asyncio.sleep(0)

    def reset(self) -> int:
        """Close every open connection by RST, in both directions; how many there were."""
        connections = tuple(self.connections)
        for connection in connections:
            connection.reset()
        return len(connections)

    def status(self) -> dict[str, Any]:
        """Connections and bytes delivered, for the control API."""
        counts = {"connections": len(self.connections), "accepted": self.accepted, "refused": self.refused}
        counts |= {f"bytes_{direction}": count for direction, count in self.bytes.items()}
        return counts | {"truth": None if self.truth is None else self.truth.status()}


class Connection:
    """A client's socket, the one to the cloud that belongs to it, and the two flows between them.

    When one side closes, what it had sent is still delivered, then the other side is closed. When the
    cloud refuses, the client is closed at once. In an outage, or where the cloud hangs, the client is
    accepted and hears nothing.
    """

    def __init__(self, relay: Relay, number: int) -> None:
        self._relay = relay
        self.number = number
        self.buffer_bytes = relay.buffer_bytes
        self.truth = relay.truth
        self._loop = asyncio.get_running_loop()
        self._how = ""
        if self.truth is not None:
            self.truth.opened(self._loop.time(), number)
        self._up = Flow(self, "up", Pipe(relay.link.up, relay.seed, number, "up"))
        self._down = Flow(self, "down", Pipe(relay.link.down, relay.seed, number, "down"))
        self._passable = asyncio.Event()
        self.client = Side(self._up, self._down, self._lost)
        self._open_sides = {self.client}
        self._reset_from_s = dict.fromkeys(("up", "down"), self._loop.time())
        self._reset_timer: asyncio.TimerHandle | None = None
        self._link = relay.link
        self.set_link(relay.link)
        self._opening = self._loop.create_task(self._open())

    def set_link(self, link: Link) -> None:
        before, self._link = self._link, link
        if link.up.outage or link.down.outage or link.up.hang:
            self._passable.clear()
        else:
            self._passable.set()
        for flow, now in ((self._up, link.up), (self._down, link.down)):
            flow.set_conditions(now)
            if flow.swallowed and not now.hang:  # what follows a gap must not be taken for the whole
                self.reset("hang")
        for direction in ("up", "down"):
            if getattr(link, direction).reset_after_ms != getattr(before, direction).reset_after_ms:
                self._reset_from_s[direction] = self._loop.time()
        self._await_reset()

    def abort(self, how: str = "closed") -> None:
        """Close both sockets now."""
        self.because(how)
        for transport in (self._up.source, self._up.target):
            if transport is not None:
                transport.abort()

    def reset(self, how: str = "reset") -> None:
        """Close both sockets by RST now."""
        for transport in (self._up.source, self._up.target):
            if transport is not None and not transport.is_closing():
                transport.get_extra_info("socket").setsockopt(
                    socket.SOL_SOCKET, socket.SO_LINGER, RST_AT_CLOSE
                )
        self.abort(how)

    def because(self, how: str) -> None:
        self._how = self._how or how

    def cut(self) -> None:
        """Close both sides, after what was delivered to them."""
        for transport in (self._up.source, self._up.target):
            if transport is not None:
                transport.close()

    def count(self, direction: str, size: int) -> None:
        self._relay.bytes[direction] += size

    def _await_reset(self) -> None:
        """Reset when it is time, in an outage not before its end: a reset is a message too."""
        if self._reset_timer is not None:
            self._reset_timer.cancel()
            self._reset_timer = None
        times_s = [
            self._reset_from_s[direction] + getattr(self._link, direction).reset_after_ms / 1e3
            for direction in ("up", "down")
            if getattr(self._link, direction).reset_after_ms
        ]
        if not times_s or self._link.up.outage or self._link.down.outage:
            return
        if min(times_s) <= self._loop.time():
            self.reset()
        else:
            self._reset_timer = self._loop.call_at(min(times_s), self._await_reset)

    async def _open(self) -> None:
        await self._passable.wait()
        cloud = Side(self._down, self._up, self._lost)
        try:
            async with asyncio.timeout(CONNECT_S):
                await self._loop.create_connection(lambda: cloud, *self._relay.target)
            self._open_sides.add(cloud)
            self._relay.target_up()
        except OSError as error:  # TimeoutError is one
            self._relay.target_down(error)
            self.abort("refused")

    def _lost(self, side: Side) -> None:
        self._opening.cancel()
        self._open_sides.discard(side)
        if not self._open_sides:
            self._end()

    def _end(self) -> None:
        self._relay.connections.discard(self)
        if self._reset_timer is not None:
            self._reset_timer.cancel()
        if self.truth is not None:
            self._up.drop()
            self._down.drop()
            self.truth.closed(self._loop.time(), self.number, self._how)


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
