"""The HTTP side of the server, in a thread of its own; `http_guard` decides who may read what."""

import asyncio
import dataclasses
import socket
import threading
import time
from collections.abc import AsyncIterator, Callable, Generator
from typing import Any

from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, generate_latest

from offboard.cloud_server.config import ServerConfig
from offboard.cloud_server.metrics import Metrics, ServerLive, Status
from offboard.cloud_server.server import Server
from offboard.common import VERSION, tasks
from offboard.common.config import as_dict
from offboard.common.errors import ConfigError, MissingExtra
from offboard.common.live.live_files import DOCS_PATHS, LOOKS, PATHS, LivePages
from offboard.common.live.look import EVERY_S, Look, Source, Viewers, encode
from offboard.common.security.http_guard import HttpGuard
from offboard.common.token_bucket import Bucket

try:
    import uvicorn
    from fastapi import FastAPI, Request, Response
    from fastapi.responses import JSONResponse, PlainTextResponse, StreamingResponse

    from offboard.common.security.bounded_http import BoundedHttp
except ImportError as error:
    raise MissingExtra("cloud-server", "cloud") from error

CONNECTIONS_A_S, CONNECTIONS_AT_ONCE = 100, 512  # new connections per second, and at once
STALL_S = 2.0  # a turn of the server's loop takes at most 0.5 s
STOP_S = 2.0
LOOKS_A_STREAM = 6  # at most; then the page asks again: `bounded_http` ends a request that takes 10 s
TICKS, UVICORN_TICK_S = 5, 0.1  # five of uvicorn's ten ticks per second are done at once


def make_http(config: ServerConfig, metrics: Metrics, server: Server, *, token: str | None) -> "HttpServer":
    app = create_app(
        server.status,
        metrics.registry,
        as_dict(config),
        token=token,
        loopback=config.http_on_loopback,
        insecure=bool(config.open_ways),
        live=ServerLive(metrics, server.status, server.robots, config.workers),
    )
    return HttpServer(app, config.http_address)


def create_app(
    status: Callable[[], Status],
    registry: CollectorRegistry,
    settings: dict[str, Any],
    *,
    token: str | None = None,
    loopback: bool = True,
    insecure: bool = False,
    live: Source | None = None,
) -> FastAPI:
    """The routes, which change nothing. `status` is called once per request, in the HTTP thread.

    With a `token`, every request needs it, except for health, readiness, the pages without their data and, on
    `loopback`, the metrics. `live`: what /live shows; None: there is no such page.
    """
    app = FastAPI(title="Offboard cloud server", version=VERSION, docs_url=None, redoc_url=None)
    open_paths = ("/health", "/ready", *(["/metrics"] if loopback else []))
    pages = DOCS_PATHS if live is None else PATHS
    app.add_middleware(LivePages, paths=pages)
    app.add_middleware(HttpGuard, token=token, open_paths=open_paths, pages=pages, loopback=loopback)
    if live is not None:
        add_looks(app, live)

    @app.get("/health", summary="200 while the server works; version and details with the token")
    async def health(request: Request) -> JSONResponse:
        now = status()
        turning = now.last_turn_age_s < STALL_S
        content: dict[str, Any] = {"healthy": turning, "insecure": insecure}
        if request.state.trusted:
            content |= {"version": VERSION, **dataclasses.asdict(now)}
        return JSONResponse(content, 200 if turning else 503)

    @app.get("/ready", summary="200 once all workers are warm")
    async def ready() -> JSONResponse:
        now = status()
        taking = now.ready and not now.draining
        return JSONResponse({"ready": taking}, 200 if taking else 503)

    @app.get("/metrics", summary="Prometheus text", response_class=PlainTextResponse)
    async def metrics() -> Response:
        return Response(generate_latest(registry), media_type=CONTENT_TYPE_LATEST)

    @app.get("/config", summary="The settings in use")
    async def config() -> dict[str, Any]:
        return settings

    @app.get("/tasks", summary="The tasks that this server runs")
    async def known_tasks() -> list[dict[str, Any]]:
        return [
            {"name": one.name, "source_hash": one.fingerprint, "duplicate": one.duplicate}
            for kind in tasks.kinds()
            for one in kind.on_servers()
        ]

    return app


def add_looks(app: FastAPI, live: Source) -> None:
    """The stream that the page /live reads."""
    viewers = Viewers()
    app.state.closing = False

    async def send(looks: Generator[Look]) -> AsyncIterator[bytes]:
        loop = asyncio.get_running_loop()
        end_s = loop.time() + LOOKS_A_STREAM * EVERY_S  # on a busy machine, a look takes longer than EVERY_S
        with viewers.one(looks):
            while loop.time() < end_s and not app.state.closing:
                yield encode(next(looks))
                await asyncio.sleep(EVERY_S)

    @app.get(LOOKS, include_in_schema=False)  # a stream, which takes seconds to end
    async def looks() -> Response:
        if viewers.full:
            return PlainTextResponse(Viewers.REFUSAL, 503)
        # The connection is closed, so that its time limit is that of this one stream.
        headers = {"connection": "close"}
        return StreamingResponse(send(live.looks()), media_type="text/event-stream", headers=headers)


class PacedHttp(BoundedHttp):
    """Accepts a limited number of connections per second, so that HTTP does not take time from the robots."""

    _left = Bucket(CONNECTIONS_A_S, CONNECTIONS_AT_ONCE, CONNECTIONS_AT_ONCE)
    _at_s = 0.0

    def connection_made(self, transport: Any) -> None:
        left, now_s = PacedHttp._left, time.monotonic()
        left.fill(now_s - PacedHttp._at_s)
        PacedHttp._at_s = now_s
        if left.level < 1:
            time.sleep(1 / CONNECTIONS_A_S)  # further connections wait in the kernel
        else:
            left.take(1)
        super().connection_made(transport)


class _Server(uvicorn.Server):
    """Checks twice per second whether to stop. Ten checks would be a third of the work of an idle server."""

    async def main_loop(self) -> None:
        ticks = 0
        while not await self.on_tick(ticks):
            await asyncio.sleep(TICKS * UVICORN_TICK_S)
            ticks += TICKS


class HttpServer:
    """Serves an app in a daemon thread, from `start` until `close`."""

    def __init__(self, app: FastAPI, address: tuple[str, int]) -> None:
        self._app = app
        self._socket = _listen(address)
        host, port = self._socket.getsockname()[:2]
        self.address = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
        config = uvicorn.Config(
            app,
            http=PacedHttp,
            ws="none",
            log_level="error",  # otherwise an attacker could fill the log with bad requests
            log_config=None,
            access_log=False,
            server_header=False,
            lifespan="off",
            timeout_graceful_shutdown=int(STOP_S),
        )
        self._server = _Server(config)
        self._thread = threading.Thread(
            target=self._server.run, kwargs={"sockets": [self._socket]}, name="web", daemon=True
        )

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        self._app.state.closing = True  # ends the streams of open pages
        self._server.should_exit = True
        if self._thread.is_alive():
            self._thread.join(2 * STOP_S)
        self._socket.close()


def _listen(address: tuple[str, int]) -> socket.socket:
    family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
    try:
        return socket.create_server(address, family=family, backlog=128)
    except OSError as error:
        host, port = address
        reason = (error.strerror or str(error)).partition(" (")[0]  # without the address that Python adds
        raise ConfigError(f"--http: {host}:{port} cannot be bound: {reason}; choose another port") from error
