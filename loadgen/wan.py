"""The relay between robot and cloud: ordinary TCP sockets, the link's conditions put on their bytes.

Works in user space, without root or kernel modules. What a link does is `link.py`; the HTTP side is
`control.py`. The TCP handshake itself is not delayed, only the bytes.
"""

import asyncio
import select
import selectors
import signal
import socket
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from common.config import check, setting
from common.errors import ConfigError
from loadgen.control import ControlServer
from loadgen.link import (
    BANDWIDTH_MBPS_MAX,
    DELAY_MS_MAX,
    DISTRIBUTIONS,
    SEGMENT_BYTES,
    Link,
    LinkConditions,
    Pipe,
)

CHUNK_BYTES = 8 * SEGMENT_BYTES  # a long read is cut, so that its first bytes do not wait for its last
CONNECT_S = 5.0
BACKLOG = 128  # connections that the kernel holds before they are accepted
PORT_MAX = 65_535


def _condition(default: Any, help: str, maximum: float | None = None, names: Iterable[str] = ()) -> Any:
    minimum = None if maximum is None else 0
    return setting(default, help, minimum=minimum, maximum=maximum, choices=tuple(names) or None)


@dataclass(frozen=True, slots=True)
class WanConfig:
    """Settings of `loadgen wan`."""

    to: str = setting("127.0.0.1:5555", "where connections are relayed to", metavar="HOST:PORT")
    listen: str = setting("127.0.0.1:5556", "where the robot connects", metavar="HOST:PORT")
    http: str = setting("127.0.0.1:8001", "where the link is read and changed", metavar="HOST:PORT")
    delay_ms: float = _condition(15.0, "delay one way, in each direction", DELAY_MS_MAX)
    jitter_ms: float = _condition(0.0, "spread of the delay, in each direction", DELAY_MS_MAX)
    distribution: str = _condition("normal", "how jitter is distributed", names=DISTRIBUTIONS)
    bandwidth_mbps: float = _condition(
        400.0, "bandwidth of each direction; 0 is unlimited", BANDWIDTH_MBPS_MAX
    )
    up_delay_ms: float | None = _condition(None, "delay from robot to cloud alone", DELAY_MS_MAX)
    up_jitter_ms: float | None = _condition(None, "jitter from robot to cloud alone", DELAY_MS_MAX)
    up_distribution: str | None = _condition(None, "jitter from robot to cloud alone", names=DISTRIBUTIONS)
    up_bandwidth_mbps: float | None = _condition(None, "bandwidth to the cloud alone", BANDWIDTH_MBPS_MAX)
    down_delay_ms: float | None = _condition(None, "delay from cloud to robot alone", DELAY_MS_MAX)
    down_jitter_ms: float | None = _condition(None, "jitter from cloud to robot alone", DELAY_MS_MAX)
    down_distribution: str | None = _condition(None, "jitter from cloud to robot alone", names=DISTRIBUTIONS)
    down_bandwidth_mbps: float | None = _condition(None, "bandwidth to the robot alone", BANDWIDTH_MBPS_MAX)
    seed: int = setting(0, "seed of the jitter")
    connections_max: int = setting(256, "connections at a time; further ones are closed", minimum=1)
    buffer_bytes: int = setting(
        8 << 20,
        "bytes under way in one direction of a connection; then the sender waits",
        minimum=CHUNK_BYTES,
    )

    def __post_init__(self) -> None:
        check(self)
        for name in ("to", "listen", "http"):
            address(f"--{name}", getattr(self, name))

    @property
    def link(self) -> Link:
        """The conditions at start."""
        return Link(self._conditions("up"), self._conditions("down"))

    def _conditions(self, direction: str) -> LinkConditions:
        values = {}
        for name in ("delay_ms", "jitter_ms", "distribution", "bandwidth_mbps"):
            own = getattr(self, f"{direction}_{name}")
            values[name] = getattr(self, name) if own is None else own
        return LinkConditions(**values)


def run_wan(config: WanConfig) -> int:
    """Relay until SIGTERM or SIGINT."""
    with asyncio.Runner(loop_factory=lambda: asyncio.SelectorEventLoop(PreciseSelector())) as runner:
        runner.run(_serve(config))
    return 0


class Relay:
    """Accepts connections, opens one to the cloud for each, and keeps the link they all share."""

    def __init__(self, config: WanConfig) -> None:
        self.config = config
        self.link = config.link
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
        if len(self.connections) >= self.config.connections_max:
            self.refused += 1
            return Refusal()
        self.accepted += 1
        connection = Connection(self, self.accepted)
        self.connections.add(connection)
        return connection.client

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
        self._pipe = Pipe(getattr(relay.link, direction), relay.config.seed, number, direction)
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
            room = self._under_way_bytes < self._relay.config.buffer_bytes
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
        self._incoming.refresh()
        self._outgoing.refresh()

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
        host, port = address("--to", self._relay.config.to)
        cloud = Side(self._down, self._up, self._lost)
        try:
            async with asyncio.timeout(CONNECT_S):
                await asyncio.get_running_loop().create_connection(lambda: cloud, host, port)
            self._open_sides.add(cloud)
        except OSError:  # TimeoutError is one
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
    """Waits to the microsecond; epoll alone rounds every timer up to a whole millisecond."""

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        if timeout is not None and timeout > 0:
            select.select([self.fileno()], [], [], timeout)
            timeout = 0
        return super().select(timeout)


def address(flag: str, text: str) -> tuple[str, int]:
    """Host and port of HOST:PORT, [HOST]:PORT for IPv6; ConfigError names the flag."""
    host, _, port = text.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not (host and port.isascii() and port.isdigit() and int(port) <= PORT_MAX):
        raise ConfigError(f"{flag}: {text!r} is not HOST:PORT with a port from 0 to {PORT_MAX}")
    return host, int(port)


async def _serve(config: WanConfig) -> None:
    with _bind("--listen", config.listen) as listening, _bind("--http", config.http) as http:
        relay = Relay(config)
        control = ControlServer(relay)
        loop = asyncio.get_running_loop()
        for stop in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(stop, control.stop)
        server = await loop.create_server(relay.accept, sock=listening, backlog=BACKLOG)
        print(f"relay {_name(listening)} -> {config.to}, control http://{_name(http)}/link", flush=True)
        await control.serve(sockets=[http])
        server.close()
        relay.abort()


def _bind(flag: str, text: str) -> socket.socket:
    host, port = address(flag, text)
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family, backlog=BACKLOG)
    except OSError as error:
        reason = (error.strerror or str(error)).partition(" (")[0]
        raise ConfigError(f"{flag}: cannot listen on {text}: {reason}") from error


def _name(listening: socket.socket) -> str:
    host, port = listening.getsockname()[:2]
    return f"{host}:{port}"
