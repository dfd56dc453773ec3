"""The control API of the relay, over HTTP: read and change the link, reset connections, play a schedule.

What a change does to bytes is left to the relay. Toxiproxy's API is in `toxiproxy/toxiproxy_api.py`.
"""

import contextlib
from collections.abc import Iterator
from typing import Any

from offboard.common.errors import ConfigError, MissingExtra
from offboard.common.live.live_files import DOCS_PATHS, LivePages
from offboard.common.security.http_guard import HttpGuard
from offboard.loadgen.relay.link.link import NAMES
from offboard.loadgen.relay.link_schedule import Schedule, parse_schedule
from offboard.loadgen.relay.tcp.relay import Relay

try:
    import uvicorn
    from fastapi import FastAPI, Request
    from fastapi.exceptions import RequestValidationError
    from fastapi.responses import JSONResponse
    from pydantic import BaseModel, ConfigDict, Field
    from starlette.exceptions import HTTPException
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

    from offboard.common.security.bounded_http import BoundedHttp
except ImportError as error:
    raise MissingExtra("the relay", "bench") from error

BODY_BYTES_MAX = 4 << 20  # 20,000 measured delays for each direction take a fifth of this
STOP_S = 1  # time for replies in progress when the relay stops


class Change(BaseModel):
    """New conditions of the link; a condition that is left out stays as it is."""

    model_config = ConfigDict(extra="forbid", strict=True)

    delay_ms: float | None = Field(None, description="delay in one direction")
    jitter_ms: float | None = Field(None, description="random part of the delay")
    distribution: str | None = Field(None, description=f"one of {', '.join(NAMES)}")
    correlation: float | None = Field(
        None, description="correlation of the jitter of neighbouring segments, 0 to 1"
    )
    samples: list[float] | None = Field(None, description="measured delays in ms, used instead of jitter")
    bandwidth_mbps: float | None = Field(None, description="0: unlimited")
    loss: float | None = Field(None, description="share of segments that are lost; TCP stalls for each")
    loss_burst: float | None = Field(
        None, description="mean number of segments lost in a row; 1: independent losses"
    )
    stall_ms: float | None = Field(
        None, description="stall of TCP for a lost segment; doubles with each further loss"
    )
    hang: bool | None = Field(None, description="read everything and answer nothing, until set to false")
    reset_after_ms: float | None = Field(None, description="reset each connection after this time; 0: never")
    truncate_bytes: int | None = Field(
        None, description="close each connection after this number of bytes; 0: never"
    )
    slow_close_ms: float | None = Field(None, description="extra delay of the end of a stream")
    outage: bool | None = Field(
        None, description="the link is silent until set to false; connections are not reset"
    )


class LinkChange(Change):
    """New conditions for both directions; `up` and `down` hold those for one direction."""

    up: Change | None = Field(None, description="robot to cloud only")
    down: Change | None = Field(None, description="cloud to robot only")


class BoundedBody:
    """Refuses a request body of more than BODY_BYTES_MAX, and reads no further."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        taken = 0

        async def receive_bounded() -> Message:
            nonlocal taken
            message = await receive()
            taken += len(message.get("body", b""))
            if taken > BODY_BYTES_MAX:
                raise HTTPException(413, f"body: longer than {BODY_BYTES_MAX} bytes")
            return message

        await self._app(scope, receive_bounded, send)


class ControlServer(uvicorn.Server):
    """Serves an API in the event loop of the relay, which handles the signals itself."""

    def __init__(self, app: FastAPI) -> None:
        options: dict[str, Any] = {"lifespan": "off", "log_level": "error", "access_log": False}
        options |= {"server_header": False, "http": BoundedHttp, "ws": "none"}
        super().__init__(uvicorn.Config(app, timeout_graceful_shutdown=STOP_S, **options))

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield

    def stop(self) -> None:
        """Make `serve` return soon."""
        self.should_exit = True


def control_app(
    relay: Relay,
    schedule: Schedule,
    *,
    token: str | None = None,
    loopback: bool = True,
    insecure: bool = False,
) -> FastAPI:
    """The control API of one relay. With a `token`, every path but /health needs it."""
    app = FastAPI(
        title="Offboard relay",
        description="Reads and changes the link between robot and cloud, live.",
        docs_url=None,
        redoc_url=None,
    )
    app.add_middleware(BoundedBody)
    app.add_middleware(LivePages, paths=DOCS_PATHS)
    app.add_middleware(HttpGuard, token=token, open_paths=("/health",), pages=DOCS_PATHS, loopback=loopback)
    _add_link(app, relay, insecure=insecure)
    _add_schedule(app, relay, schedule)
    app.add_exception_handler(ConfigError, _bad_value)
    app.add_exception_handler(RequestValidationError, _bad_request)
    return app


def _add_link(app: FastAPI, relay: Relay, *, insecure: bool) -> None:
    @app.get("/health")
    async def health() -> dict[str, Any]:
        """The event loop of the relay is running."""
        return {"status": "ok", "insecure": insecure}

    @app.get("/link")
    async def read_link() -> dict[str, Any]:
        """Conditions of both directions, number of connections, bytes delivered."""
        return _shown(relay)

    @app.put("/link")
    async def change_link(change: LinkChange) -> dict[str, Any]:
        """Change some conditions, for all bytes that arrive from now on. Returns the whole link."""
        relay.set_link(relay.link.changed(change.model_dump(exclude_none=True)), by="http")
        return _shown(relay)

    @app.post("/recording")
    async def begin_recording() -> dict[str, Any]:
        """Play the recording of the link from its beginning. Returns the whole link."""
        relay.begin_recording()
        return _shown(relay)

    @app.post("/reset")
    async def reset() -> dict[str, int]:
        """Reset every open connection now. Returns how many there were."""
        return {"reset": relay.reset()}


def _add_schedule(app: FastAPI, relay: Relay, schedule: Schedule) -> None:
    @app.get("/schedule")
    async def read_schedule() -> dict[str, Any]:
        """Seconds since the start, number of events played, and all events in order."""
        return schedule.status()

    @app.post("/schedule")
    async def start_schedule(events: dict[str, Any]) -> dict[str, Any]:
        """Play `{"event": [{"at_s": 5.0, "up": {"outage": true}}, ...]}` instead of an earlier schedule."""
        schedule.start(parse_schedule(events, relay.link))
        return schedule.status()

    @app.delete("/schedule")
    async def stop_schedule() -> dict[str, Any]:
        """Forget the events that are left; the link stays as it is."""
        schedule.stop()
        return schedule.status()


async def _bad_value(_request: Request, error: Exception) -> JSONResponse:
    return JSONResponse({"detail": str(error)}, 422)


async def _bad_request(_request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError)
    return JSONResponse({"detail": "; ".join(map(_sentence, error.errors()))}, 422)


def _shown(relay: Relay) -> dict[str, Any]:
    link = relay.link
    outage = link.up.outage and link.down.outage
    return {"up": link.up.shown(), "down": link.down.shown(), "outage": outage, **relay.status()}


def _sentence(error: dict[str, Any]) -> str:
    """A pydantic error as one line: the field, what is wrong, what is allowed."""
    name = ".".join(str(part) for part in error["loc"][1:]) or "body"
    if error["type"] == "extra_forbidden":
        known = Change.model_fields if len(error["loc"]) > 2 else LinkChange.model_fields
        return f"{name}: unknown condition; known: {', '.join(known)}"
    if error["type"] == "json_invalid":
        return f"body: not JSON: {error['ctx']['error']}"
    return f"{name}: {error['input']!r}: {error['msg']}"
