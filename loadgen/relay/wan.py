"""The command `loadgen wan`: the relay between robot and cloud, its settings and its HTTP side together.

The sockets are in `relay.py`, the HTTP side is `control.py`.
"""

import asyncio
import contextlib
import signal
from dataclasses import dataclass
from pathlib import Path

from offboard.common.config import setting
from offboard.common.errors import ConfigError
from offboard.common.security.exposure import LOOPBACK, OPEN_REMEDY, on_loopback, warn_each_minute
from offboard.common.security.private_files import read_token
from offboard.loadgen.relay.http_control import ControlServer, control_app
from offboard.loadgen.relay.link.link import CHUNK_BYTES
from offboard.loadgen.relay.link.link_settings import LinkFlags
from offboard.loadgen.relay.schedule import Schedule, read_schedule
from offboard.loadgen.relay.tcp.endpoint import BACKLOG, address, bind, name_of
from offboard.loadgen.relay.tcp.link_record import Truth
from offboard.loadgen.relay.tcp.relay import PreciseSelector, Relay
from offboard.loadgen.relay.toxiproxy.proxies import Proxies, RelaySettings
from offboard.loadgen.relay.toxiproxy.toxiproxy_api import toxiproxy_app

END_S = 1.0  # for the connections to end when the relay does


@dataclass(frozen=True, slots=True)
class WanConfig(LinkFlags):
    """Settings of `loadgen wan`: the link at start, and everything else."""

    to: str = setting("127.0.0.1:5555", "where connections are relayed to", metavar="HOST:PORT")
    listen: str = setting("127.0.0.1:5556", "where the robot connects", metavar="HOST:PORT")
    http: str = setting(
        "127.0.0.1:8001",
        "where the link is read and changed; beyond loopback --token-file is needed",
        metavar="HOST:PORT",
    )
    token_file: Path | None = setting(
        None, "file with the bearer token that --http asks for, but for /health"
    )
    insecure: bool = setting(
        False, "without a token let anybody beyond loopback change the link; warns every minute"
    )
    schedule: Path | None = setting(
        None, "TOML file of changes of the link: [[event]] at_s = 5.0, loss = 0.1"
    )
    truth: Path | None = setting(None, "file to write what the link did to each chunk, as JSON Lines")
    seed: int = setting(0, "seed of jitter and loss")
    connections_max: int = setting(256, "connections at a time; further ones are closed", minimum=1)
    toxiproxy: str | None = setting(
        None,
        "where Toxiproxy's API makes further relays for its clients; loopback only; their own port is 8474",
        metavar="HOST:PORT",
    )
    buffer_bytes: int = setting(
        8 << 20,
        "bytes under way in one direction of a connection; then the sender waits",
        minimum=CHUNK_BYTES,
    )

    def __post_init__(self) -> None:
        LinkFlags.__post_init__(self)
        for name in ("to", "listen", "http"):
            address(f"--{name}", getattr(self, name))
        if self.toxiproxy is not None and not on_loopback(address("--toxiproxy", self.toxiproxy)[0]):
            raise ConfigError(
                f"--toxiproxy: {self.toxiproxy!r} is not on loopback ({LOOPBACK}):"
                " whoever reaches it commands the relay"
            )
        for way in () if self.insecure else self.open_ways:
            raise ConfigError(f"{way}: {OPEN_REMEDY}")

    @property
    def http_on_loopback(self) -> bool:
        return on_loopback(address("--http", self.http)[0])

    @property
    def open_ways(self) -> tuple[str, ...]:
        """Why anybody may command the relay who reaches this computer."""
        if self.token_file is not None or self.http_on_loopback:
            return ()
        return (f"--http: {self.http} is beyond loopback and without --token-file",)


def run_wan(config: WanConfig) -> int:
    """Relay until SIGTERM or SIGINT."""
    with asyncio.Runner(loop_factory=lambda: asyncio.SelectorEventLoop(PreciseSelector())) as runner:
        runner.run(_serve(config))
    return 0


async def _serve(config: WanConfig) -> None:
    token = read_token(config.token_file)
    with contextlib.ExitStack() as sockets:
        listening = sockets.enter_context(bind("--listen", config.listen))
        http = sockets.enter_context(bind("--http", config.http))
        loop = asyncio.get_running_loop()
        events = () if config.schedule is None else read_schedule(config.schedule, config.link)
        truth = None if config.truth is None else Truth(config.truth, loop.time())
        relay = Relay(
            address("--to", config.to),
            config.link,
            seed=config.seed,
            connections_max=config.connections_max,
            buffer_bytes=config.buffer_bytes,
            truth=truth,
        )
        schedule = Schedule(relay)
        app = control_app(
            relay,
            schedule,
            token=token,
            loopback=config.http_on_loopback,
            insecure=bool(config.open_ways),
        )
        servers = [(ControlServer(app), http)]
        where = f"relay {name_of(listening)} -> {config.to}, control http://{name_of(http)}/link"
        proxies = Proxies(RelaySettings(config.seed, config.connections_max, config.buffer_bytes))
        if config.toxiproxy is not None:
            toxiproxy = sockets.enter_context(bind("--toxiproxy", config.toxiproxy))
            servers.append((ControlServer(toxiproxy_app(proxies)), toxiproxy))
            where += f", toxiproxy http://{name_of(toxiproxy)}"

        def stop() -> None:
            for server, _ in servers:
                server.stop()

        for sent in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(sent, stop)
        listener = await loop.create_server(relay.accept, sock=listening, backlog=BACKLOG)
        schedule.start(events)
        print(where, flush=True)
        if config.open_ways:
            warn_each_minute(config.open_ways)
        await asyncio.gather(*(server.serve(sockets=[at]) for server, at in servers))
        listener.close()
        schedule.stop()
        relay.abort()
        proxies.close()
        if truth is not None:
            await relay.ended(END_S)
            truth.close(loop.time())
