"""The command `loadgen wan`: the relay between robot and cloud, its settings and its HTTP side together.

The sockets are in `relay.py`, the HTTP side is `control.py`.
"""

import asyncio
import signal
import socket
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from common.config import check, setting
from common.errors import ConfigError
from loadgen.control import ControlServer
from loadgen.link import (
    BANDWIDTH_MBPS_MAX,
    DELAY_MS_MAX,
    DISTRIBUTIONS,
    Link,
    LinkConditions,
)
from loadgen.relay import CHUNK_BYTES, PreciseSelector, Relay

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


def address(flag: str, text: str) -> tuple[str, int]:
    """Host and port of HOST:PORT, [HOST]:PORT for IPv6; ConfigError names the flag."""
    host, _, port = text.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not (host and "/" not in host and port.isascii() and port.isdigit() and int(port) <= PORT_MAX):
        raise ConfigError(f"{flag}: {text!r} is not HOST:PORT with a port from 0 to {PORT_MAX}")
    return host, int(port)


async def _serve(config: WanConfig) -> None:
    with _bind("--listen", config.listen) as listening, _bind("--http", config.http) as http:
        relay = Relay(
            address("--to", config.to),
            config.link,
            seed=config.seed,
            connections_max=config.connections_max,
            buffer_bytes=config.buffer_bytes,
        )
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
