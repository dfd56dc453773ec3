"""`loadgen wan`: its settings, and the relay and the HTTP servers that it runs.

The relay is in `tcp.relay`, its HTTP control API in `control_api`.
"""

import asyncio
import contextlib
import select
import selectors
import signal
import time
from dataclasses import dataclass
from pathlib import Path

from offboard.common.config import setting
from offboard.common.errors import ConfigError
from offboard.common.security.address import LOOPBACK, OPEN_REMEDY, address, on_loopback, warn_each_minute
from offboard.common.security.plain_files import read_token
from offboard.loadgen.relay.control_api import ControlServer, control_app
from offboard.loadgen.relay.link.link_settings import RECORDED, LinkFlags
from offboard.loadgen.relay.link.pipe import CHUNK_BYTES
from offboard.loadgen.relay.link_schedule import Schedule, read_schedule
from offboard.loadgen.relay.tcp.link_record import LinkRecord
from offboard.loadgen.relay.tcp.relay import BACKLOG, Relay, RelaySettings, bind, name_of
from offboard.loadgen.relay.toxiproxy.proxies import Proxies
from offboard.loadgen.relay.toxiproxy.toxiproxy_api import toxiproxy_app

SPIN_S = 0.0003
END_S = 1.0  # time for the connections to end when the relay stops
ADDRESSES, ACCESS, RUN, LIMITS = "addresses", "access", "run", "limits"


@dataclass(frozen=True)
class AddressFlags:
    """Where the relay listens, and who may change it."""

    to: str = setting("127.0.0.1:5555", "address of the server", group=ADDRESSES, metavar="HOST:PORT")
    listen: str = setting(
        "127.0.0.1:5556", "address where robots connect", group=ADDRESSES, metavar="HOST:PORT"
    )
    http: str = setting(
        "127.0.0.1:8001",
        "address of the HTTP API that reads and changes the link; beyond loopback it needs --token-file",
        group=ADDRESSES,
        metavar="HOST:PORT",
    )
    toxiproxy: str | None = setting(
        None,
        "address that speaks the API of Toxiproxy, whose own port is 8474; loopback only",
        group=ADDRESSES,
        rare=True,
        metavar="HOST:PORT",
    )
    token_file: Path | None = setting(
        None, "file with the bearer token that --http needs, except for /health", group=ACCESS
    )
    insecure: bool = setting(
        False,
        "let anybody beyond loopback change the link without a token; logs a warning every minute",
        group=ACCESS,
        rare=True,
    )


# The help shows the fields of the last base class first.
@dataclass(frozen=True)
class WanConfig(LinkFlags, AddressFlags):
    """The settings of `loadgen wan`."""

    schedule: Path | None = setting(
        None, "TOML file of changes of the link, such as [[event]] at_s = 5.0, loss = 0.1", group=RUN
    )
    recording_waits: bool = setting(
        False,
        "hold the first row of the recording, and begin at POST /recording (default: begin at once)",
        group=RECORDED,
        rare=True,
    )
    truth: Path | None = setting(
        None, "write what the link did to each chunk to this file, as JSON Lines", group=RUN
    )
    seed: int = setting(0, "seed of jitter and loss", group=RUN)
    connections_max: int = setting(
        256, "connections at the same time; further ones are closed", group=LIMITS, rare=True, minimum=1
    )
    buffer_bytes: int = setting(
        8 << 20,
        "bytes on their way in one direction of a connection; with more, the sender has to wait",
        group=LIMITS,
        rare=True,
        minimum=CHUNK_BYTES,
    )

    def __post_init__(self) -> None:
        LinkFlags.__post_init__(self)
        for name in ("to", "listen", "http"):
            address(f"--{name}", getattr(self, name))
        if self.toxiproxy is not None and not on_loopback(address("--toxiproxy", self.toxiproxy)[0]):
            raise ConfigError(
                f"--toxiproxy: {self.toxiproxy!r} is not on loopback ({LOOPBACK}):"
                " anybody who reaches it can control the relay"
            )
        for way in () if self.insecure else self.open_ways:
            raise ConfigError(f"{way}: {OPEN_REMEDY}")

    @property
    def http_on_loopback(self) -> bool:
        return on_loopback(address("--http", self.http)[0])

    @property
    def open_ways(self) -> tuple[str, ...]:
        """The flags that let anybody who reaches this computer control the relay."""
        if self.token_file is not None or self.http_on_loopback:
            return ()
        return (f"--http: {self.http} is beyond loopback and without --token-file",)


def run_wan(config: WanConfig) -> int:
    """Relay until SIGTERM or Ctrl-C."""
    loop = asyncio.SelectorEventLoop(PreciseSelector())
    try:
        loop.run_until_complete(_serve(config))
    finally:
        loop.run_until_complete(_end_rest(loop))
        loop.close()
    return 0


async def _serve(config: WanConfig) -> None:
    token = read_token(config.token_file)
    with contextlib.ExitStack() as sockets:
        listening = sockets.enter_context(bind("--listen", config.listen))
        http = sockets.enter_context(bind("--http", config.http))
        loop = asyncio.get_running_loop()
        events = () if config.schedule is None else read_schedule(config.schedule, config.link)
        record = None if config.truth is None else LinkRecord(config.truth, loop.time())
        settings = RelaySettings(config.seed, config.connections_max, config.buffer_bytes)
        relay = Relay(address("--to", config.to), config.link, settings, record=record)
        schedule = Schedule(relay)
        app = control_app(
            relay, schedule, token=token, loopback=config.http_on_loopback, insecure=bool(config.open_ways)
        )
        servers = [(ControlServer(app), http)]
        where = f"relay {name_of(listening)} -> {config.to}, control http://{name_of(http)}/link"
        proxies = Proxies(settings)
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
        if relay.link.recorded and not config.recording_waits:
            relay.begin_recording()
        print(where, flush=True)
        if config.open_ways:
            warn_each_minute(config.open_ways)
        await asyncio.gather(*(server.serve(sockets=[at]) for server, at in servers))
        listener.close()
        schedule.stop()
        relay.abort()
        proxies.close()
        if record is not None:
            await relay.ended(END_S)
            record.close(loop.time())


async def _end_rest(loop: asyncio.AbstractEventLoop) -> None:
    """End what `_serve` has left, as `asyncio.run` does."""
    rest = asyncio.all_tasks() - {asyncio.current_task()}
    for task in rest:
        task.cancel()
    await asyncio.gather(*rest, return_exceptions=True)
    await loop.shutdown_asyncgens()
    await loop.shutdown_default_executor()


class PreciseSelector(selectors.EpollSelector):
    """Ends a wait on time, where epoll alone rounds every timer up to a whole millisecond.

    A core that sleeps wakes up about 0.2 ms late, so the last SPIN_S of a wait are polled.
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
