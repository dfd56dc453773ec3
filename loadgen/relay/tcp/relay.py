"""The relay: accepts TCP connections, and applies the conditions of the link to their bytes.

It works in user space, without root and without kernel modules. It delays the bytes, but not the TCP
handshake itself. The link model is in `relay/link`, a single connection is in `connection.py`.
"""

import asyncio
import contextlib
import logging
from typing import Any

from offboard.common.errors import ConfigError
from offboard.loadgen.relay.link.link import Link
from offboard.loadgen.relay.tcp.connection import Connection
from offboard.loadgen.relay.tcp.forwarder import ReadBuffer
from offboard.loadgen.relay.tcp.link_record import LinkRecord

log = logging.getLogger(__name__)


class Relay:
    """Opens a connection to `target` (host, port) for each one that it accepts, and owns their link.

    - `connections_max`: connections at a time. When all are taken, a connection whose client has left is
      ended to make room for the next one.
    - `buffer_bytes`: bytes under way in one direction of one connection.
    - `record`: writes down everything that the link does.
    """

    def __init__(
        self,
        target: tuple[str, int],
        link: Link,
        *,
        seed: int,
        connections_max: int,
        buffer_bytes: int,
        record: LinkRecord | None = None,
    ) -> None:
        self.target = target
        self.link = link
        self.seed = seed
        self.buffer = ReadBuffer()
        self.buffer_bytes = buffer_bytes
        self.record = record
        self._connections_max = connections_max
        self._target_is_up = True
        self.connections: set[Connection] = set()  # bounded by connections_max
        self.accepted = 0
        self.refused = 0
        self.bytes = {"up": 0, "down": 0}
        if record is not None:
            record.conditions(asyncio.get_running_loop().time(), "flag", link)

    def set_link(self, link: Link, by: str = "http") -> None:
        """Change the link for all bytes that arrive from now on."""
        self.link = link
        if self.record is not None:
            self.record.conditions(asyncio.get_running_loop().time(), by, link)
        for connection in tuple(self.connections):
            connection.set_link(link)

    def begin_recording(self) -> None:
        """Play the recording of the link from its beginning; ConfigError if there is none."""
        if not self.link.recorded:
            raise ConfigError("recording: this link plays none; remedy: start the relay with --recording")
        self.set_link(self.link.begun(asyncio.get_running_loop().time()), by="recording")

    def accept(self) -> asyncio.BaseProtocol:
        """The protocol for the socket of a client that was just accepted."""
        if len(self.connections) >= self._connections_max and not self._make_room():
            self.refused += 1
            return Refusal()
        self.accepted += 1
        connection = Connection(self, self.accepted)
        self.connections.add(connection)
        return connection.client

    def _make_room(self) -> bool:
        """End the oldest connection whose client has left, and return whether there was one."""
        for connection in sorted(self.connections, key=lambda one: one.number):
            if connection.left:
                connection.reset("client")
                self.connections.discard(connection)
                return True
        return False

    def target_up(self) -> None:
        self._target_is_up = True

    def target_down(self, error: OSError) -> None:
        """Log, once, that the cloud accepts no connections, so that clients are disconnected."""
        if self._target_is_up:
            log.warning("cannot connect to %s:%d: %s; remedy: start it, or correct --to", *self.target, error)
        self._target_is_up = False

    def abort(self) -> None:
        """Close every connection now."""
        for connection in tuple(self.connections):
            connection.abort("stopped")

    async def ended(self, within_s: float) -> None:
        """Return when no connection is left, or after `within_s`."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(within_s):
                while self.connections:
                    await asyncio.sleep(0)

    def reset(self) -> int:
        """Close every open connection by RST, on both sides, and return how many there were."""
        connections = tuple(self.connections)
        for connection in connections:
            connection.reset()
        return len(connections)

    def status(self) -> dict[str, Any]:
        """Connections and delivered bytes, for the control API."""
        counts = {"connections": len(self.connections), "accepted": self.accepted, "refused": self.refused}
        counts |= {f"bytes_{direction}": count for direction, count in self.bytes.items()}
        return counts | {"truth": None if self.record is None else self.record.status()}


class Refusal(asyncio.Protocol):
    """Closes a connection that exceeds the limit."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        transport.close()
