"""The relay: accepts TCP connections, and applies the conditions of the link to their bytes.

It works in user space, without root and without kernel modules. It delays the bytes, but not the TCP
handshake itself. The link model is in `relay/link`, a single connection is in `connection.py`.
"""

import asyncio
import logging
import socket
from dataclasses import dataclass
from typing import Any

from offboard.common.errors import ConfigError
from offboard.common.security.address import address
from offboard.loadgen.relay.link.link import Link
from offboard.loadgen.relay.tcp.connection import Connection
from offboard.loadgen.relay.tcp.forwarder import Shared
from offboard.loadgen.relay.tcp.link_record import LinkRecord

BACKLOG = 128  # connections that the kernel holds before they are accepted

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class RelaySettings:
    """The settings of a relay.

    - `connections_max`: connections at a time. When all are taken, a connection whose client has left is
      ended to make room for the next one.
    - `buffer_bytes`: bytes under way in one direction of one connection.
    """

    seed: int
    connections_max: int
    buffer_bytes: int


class Relay:
    """Opens a connection to `target` (host, port) for each one that it accepts, and owns their link.

    `record` writes down everything that the link does.
    """

    def __init__(
        self,
        target: tuple[str, int],
        link: Link,
        settings: RelaySettings,
        *,
        record: LinkRecord | None = None,
    ) -> None:
        self.target = target
        self.link = link
        self.seed = settings.seed
        self.shared = Shared(settings.buffer_bytes, record)
        self._connections_max = settings.connections_max
        self._target_is_up = True
        self.connections: set[Connection] = set()  # bounded by connections_max
        self.accepted = 0
        self.refused = 0
        if record is not None:
            record.conditions(asyncio.get_running_loop().time(), "flag", link)

    def set_link(self, link: Link, by: str = "http") -> None:
        """Change the link for all bytes that arrive from now on."""
        self.link = link
        if self.shared.record is not None:
            self.shared.record.conditions(asyncio.get_running_loop().time(), by, link)
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

    def target_down(self, error: Exception) -> None:
        """Log, once, that the cloud accepts no connections, so that clients are disconnected."""
        if self._target_is_up:
            log.warning("cannot connect to %s:%d: %s; remedy: start it, or correct --to", *self.target, error)
        self._target_is_up = False

    def abort(self) -> None:
        for connection in tuple(self.connections):
            connection.abort("stopped")

    async def ended(self, within_s: float) -> None:
        """Return when no connection is left, or after `within_s`."""
        now_s = asyncio.get_running_loop().time
        until_s = now_s() + within_s
        while self.connections and now_s() < until_s:
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
        counts |= {f"bytes_{direction}": count for direction, count in self.shared.bytes.items()}
        record = self.shared.record
        return counts | {"truth": None if record is None else record.status()}


class Refusal(asyncio.Protocol):
    """Closes a connection that exceeds the limit."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        transport.close()


def bind(flag: str, text: str) -> socket.socket:
    """A socket that listens at HOST:PORT; ConfigError names the flag and the reason."""
    host, port = address(flag, text)
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    both = host == "::" and socket.has_dualstack_ipv6()  # IPv4 too
    try:
        return socket.create_server((host, port), family=family, backlog=BACKLOG, dualstack_ipv6=both)
    except OSError as error:
        reason = (error.strerror or str(error)).partition(" (")[0]
        raise ConfigError(f"{flag}: cannot listen on {text}: {reason}") from error


def name_of(listening: socket.socket) -> str:
    """The HOST:PORT where a socket listens, with its real port."""
    host, port = listening.getsockname()[:2]
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
