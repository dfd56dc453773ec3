"""The relay's HTTP side: read the link, change it, reset its connections, play a schedule.

What a change does to bytes under way is the business of `relay.py`.
"""

import contextlib
from collections.abc import Iterator
from typing import Any, Protocol

from offboard.common.errors import ConfigError, MissingExtra
from offboard.common.security.http_guard import HttpGuard
from offboard.loadgen.relay.link.link import NAMES
from offboard.loadgen.relay.schedule import Linked, Schedule, parse_schedule

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

BODY_BYTES_MAX = 4 << 20  # 20,000 delays for each direction take a fifth of it
STOP_S = 1  # how long a reply in progress may take when the relay stops


class Relayed(Linked, Protocol):
    """The relay, as far as it is commanded over HTTP."""

    def status(self) -> dict[str, Any]:
        """What else there is to show."""


class Change(BaseModel):
    """New conditions; what is left out stays as it is."""

    model_config = ConfigDict(extra="forbid", strict=True)

    delay_ms: float | None = Field(None, description="delay one way")
    jitter_ms: float | None = Field(None, description="spread of the delay")
    distribution: str | None = Field(None, description=f"one of {', '.join(NAMES)}")
    correlation: float | None = Field(None, description="of the jitter of neighbouring segments")
    samples: list[float] | None = Field(None, description="delays in ms to add in place of jitter")
    bandwidth_mbps: float | None = Field(None, description="0 is unlimited")
    loss: float | None = Field(None, description="share of segments lost; each is a stall")
    loss_burst: float | None = Field(None, description="mean segments lost in a row; 1 is independent loss")
    stall_ms: float | None = Field(None, description="how much later a lost segment comes")
    hang: bool | None = Field(None, description="take everything, answer nothing until it is set to false")
    reset_after_ms: float | None = Field(None, description="reset connections after so long; 0 is never")
    truncate_bytes: int | None = Field(None, description="close connections after so many bytes; 0 is never")
    slow_close_ms: float | None = Field(None, description="how much later the end of a stream comes")
    outage: bool | None = Field(None, description="silence until it is set to false again; not a reset")


class LinkChange(Change):
    """Conditions for both directions, or under `up` and `down` for one."""

    up: Change | None = Field(None, description="robot to cloud alone")
    down: Change | None = Field(None, description="cloud to robot alone")


class BoundedBody:
    """Takes no request body of more than BODY_BYTES_MAX: the rest of it is not kept."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        taken = 0

        async def receive_bounded() -> Message:
            nonlocal taken
            message = await receive()
            taken += len(message.get("body", b""))
            if taken > BODY_BYTES_MAX:
                raise HTTPException(413, f"body: {BODY_BYTES_MAX} bytes is the most")
            return message

        await self._app(scope, receive_bounded, send)


class ControlServer(uvicorn.Server):
    """Serves an API in the relay's own event loop; signals are left to the relay."""

    def __init__(self, app: FastAPI) -> None:
        options: dict[str, Any] = {"lifespan": "off", "log_level": "error", "access_log": False}
        options |= {"server_header": False, "http": BoundedHttp}
        super().__init__(uvicorn.Config(app, timeout_graceful_shutdown=STOP_S, **options))

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield

    def stop(self) -> None:
        """Let `serve` return soon."""
        self.should_exit = True


def control_app(
    relay: Relayed,
    schedule: Schedule,
    *,
    token: str | None = None,
    loopback: bool = True,
    insecure: bool = False,
) -> FastAPI:
    """The API over one relay; with a `token` everything but health needs it."""
    app = FastAPI(
        title="Offboard relay",
        description="The link between robot and cloud, read and changed live.",
        redoc_url=None,
    )
    app.add_middleware(BoundedBody)
    app.add_middleware(HttpGuard, token=token, open_paths=("/health",), loopback=loopback)

    @app.get("/health")
    async def health() -> dict[str, Any]:
        """The relay's loop turns."""
        return {"status": "ok", "insecure": insecure}

    @app.get("/link")
    async def read_link() -> dict[str, Any]:
        """Conditions of both directions, connections, bytes delivered."""
        return _shown(relay)

    @app.put("/link")
    async def change_link(change: LinkChange) -> dict[str, Any]:
        """Change some conditions for the bytes that arrive from now on; answers the whole link."""
        relay.set_link(relay.link.changed(change.model_dump(exclude_none=True)), by="http")
        return _shown(relay)

    @app.post("/reset")
    async def reset() -> dict[str, int]:
        """Reset every open connection now; answers how many there were."""
        return {"reset": relay.reset()}

    @app.get("/schedule")
    async def read_schedule() -> dict[str, Any]:
        """Seconds since the start, events done, and all events in order."""
        return schedule.status()

    @app.post("/schedule")
    async def start_schedule(events: dict[str, Any]) -> dict[str, Any]:
        """Play `{"event": [{"at_s": 5.0, "up": {"outage": true}}, ...]}` from now on, in place of another."""
        schedule.start(parse_schedule(events, relay.link))
        return schedule.status()

    @app.delete("/schedule")
    async def stop_schedule() -> dict[str, Any]:
        """Forget what is left of the schedule; the link stays as it is."""
        schedule.stop()
        return schedule.status()

    @app.exception_handler(ConfigError)
    async def bad_value(_request: Request, error: ConfigError) -> JSONResponse:
        return JSONResponse({"detail": str(error)}, 422)

    @app.exception_handler(RequestValidationError)
    async def bad_request(_request: Request, error: RequestValidationError) -> JSONResponse:
        return JSONResponse({"detail": "; ".join(map(_sentence, error.errors()))}, 422)

    return app


def _shown(relay: Relayed) -> dict[str, Any]:
    link = relay.link
    outage = link.up.outage and link.down.outage
    return {"up": link.up.shown(), "down": link.down.shown(), "outage": outage, **relay.status()}


def _sentence(error: dict[str, Any]) -> str:
    """One pydantic error as `field: what is wrong; what is allowed`."""
    name = ".".join(str(part) for part in error["loc"][1:]) or "body"
    if error["type"] == "extra_forbidden":
        known = Change.model_fields if len(error["loc"]) > 2 else LinkChange.model_fields
        return f"{name}: unknown condition; known: {', '.join(known)}"
    if error["type"] == "json_invalid":
        return f"body: not JSON: {error['ctx']['error']}"
    return f"{name}: {error['input']!r}: {error['msg']}"
