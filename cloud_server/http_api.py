"""HTTP beside the socket: health, readiness, metrics, settings and tasks, from a thread of its own."""

import asyncio
import dataclasses
import socket
import threading
import time
from collections.abc import Callable
from typing import Any

from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, generate_latest

from offboard.cloud_server.metrics import Status
from offboard.common import VERSION, tasks
from offboard.common.errors import ConfigError, MissingExtra
from offboard.common.security.http_guard import HttpGuard
from offboard.common.token_bucket import Bucket

try:
    import uvicorn
    from fastapi import FastAPI, Request, Response
    from fastapi.responses import JSONResponse, PlainTextResponse

    from offboard.common.security.bounded_http import BoundedHttp
except ImportError as error:
    raise MissingExtra("cloud-server", "cloud") from error

CONNECTIONS_A_S, CONNECTIONS_AT_ONCE = 100, 512
STALL_S = 2.0  # the loop turns at least every 0.5 s
STOP_S = 2.0
TICKS, UVICORN_TICK_S = 5, 0.1  # of uvicorn's ten a second so many at once; with each tenth it sets the date


def create_app(
    status: Callable[[], Status],
    registry: CollectorRegistry,
    settings: dict[str, Any],
    *,
    token: str | None = None,
    loopback: bool = True,
    insecure: bool = False,
) -> FastAPI:
    """The routes, all to be read only; `status` is called once a request, from the web thread.

    With a `token` everything needs it but health, readiness and, on `loopback`, the metrics.
    """
    app = FastAPI(title="Offboard cloud server", version=VERSION, redoc_url=None)
    open_paths = ("/health", "/ready", *(["/metrics"] if loopback else []))
    app.add_middleware(HttpGuard, token=token, open_paths=open_paths, loopback=loopback)

    @app.get("/health", summary="200 while the loop turns; version and details with the token")
    async def health(request: Request) -> JSONResponse:
        now = status()
        turning = now.last_turn_age_s < STALL_S
        content: dict[str, Any] = {"healthy": turning, "insecure": insecure}
        if request.state.trusted:
            content |= {"version": VERSION, **dataclasses.asdict(now)}
        return JSONResponse(content, 200 if turning else 503)

    @app.get("/ready", summary="200 once every kind is warm in every worker")
    async def ready() -> JSONResponse:
        now = status()
        taking = now.ready and not now.draining
        return JSONResponse({"ready": taking}, 200 if taking else 503)

    @app.get("/metrics", summary="Prometheus text", response_class=PlainTextResponse)
    async def metrics() -> Response:
        return Response(generate_latest(registry), media_type=CONTENT_TYPE_LATEST)

    @app.get("/config", summary="The resolved settings")
    async def config() -> dict[str, Any]:
        return settings

    @app.get("/tasks", summary="What can be run here")
    async def known_tasks() -> list[dict[str, Any]]:
        return [
            {"name": k.name, "source_hash": k.source_hash, "duplicate": k.duplicate} for k in tasks.kinds()
        ]

    return app


class PacedHttp(BoundedHttp):
    """Takes only so many new connections a second: the web thread shall not take the robots' time."""

    _left = Bucket(CONNECTIONS_A_S, CONNECTIONS_AT_ONCE, CONNECTIONS_AT_ONCE)
    _at_s = 0.0

    def connection_made(self, transport: Any) -> None:
        left, now_s = PacedHttp._left, time.monotonic()
        left.fill(now_s - PacedHttp._at_s)
        PacedHttp._at_s = now_s
        if left.level < 1:
            time.sleep(1 / CONNECTIONS_A_S)  # others wait in the kernel's queue
        else:
            left.take(1)
        super().connection_made(transport)


class _Server(uvicorn.Server):
    """Looks twice a second whether it is to stop: ten looks are a third of what a server at rest does."""

    async def main_loop(self) -> None:
        ticks = 0
        while not await self.on_tick(ticks):
            await asyncio.sleep(TICKS * UVICORN_TICK_S)
            ticks += TICKS


class Web:
    """Serves an app in a daemon thread, from `start` until `close`."""

    def __init__(self, app: FastAPI, address: tuple[str, int]) -> None:
        self._socket = _listen(address)
        host, port = self._socket.getsockname()[:2]
        self.address = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
        config = uvicorn.Config(
            app,
            http=PacedHttp,
            log_level="error",  # a line for every bad request would be the attacker's to write
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
        reason = (error.strerror or str(error)).partition(" (")[0]  # Python adds the address again
        raise ConfigError(f"--http: {host}:{port} cannot be bound: {reason}") from error
