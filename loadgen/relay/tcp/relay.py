"""The relay: ordinary TCP connections, the link's conditions put on their bytes.

Works in user space, without root or kernel modules. What a link does is `link.py`, one connection is
`connection.py`; who starts the relay and changes its link is `wan.py`. The TCP handshake itself is not
delayed, only the bytes.
"""

import asyncio
import contextlib
import logging
import select
import selectors
import time
from typing import Any

from offboard.loadgen.relay.link.link import Link
from offboard.loadgen.relay.tcp.connection import Connection
from offboard.loadgen.relay.tcp.flow import ReadBuffer
from offboard.loadgen.relay.tcp.link_record import Truth

SPIN_S = 0.0003

log = logging.getLogger(__name__)


class Relay:
    """Accepts connections, opens one to `target` (host, port) for each, and keeps the link they all share.

    At most `connections_max` at a time, and `buffer_bytes` under way in one direction of one of them.
    When all are taken, one whose client has left makes room for the next. What happens is told to `truth`.
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
        self.buffer = ReadBuffer()
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

    def accept(self) -> asyncio.BaseProtocol:
        """The protocol of a client's socket that was just accepted."""
        if len(self.connections) >= self._connections_max and not self._make_room():
            self.refused += 1
            return Refusal()
        self.accepted += 1
        connection = Connection(self, self.accepted)
        self.connections.add(connection)
        return connection.client

    def _make_room(self) -> bool:
        """Whether the oldest connection whose client has left was ended."""
        for connection in sorted(self.connections, key=lambda one: one.number):
            if connection.left:
                connection.reset("client")
                self.connections.discard(connection)
                return True
        return False

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
