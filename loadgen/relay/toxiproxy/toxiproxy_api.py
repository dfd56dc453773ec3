"""Toxiproxy's HTTP API (https://github.com/Shopify/toxiproxy#http-api), for its clients in any language.

docs/test_bench.md lists the differences. Proxies and toxics are implemented in `proxies.py` and `toxics.py`.
"""

from dataclasses import replace
from typing import Annotated, Any, TypeVar

from offboard.common import VERSION
from offboard.common.errors import MissingExtra
from offboard.loadgen.relay.toxiproxy.proxies import LISTEN, Proxies, ProxySettings
from offboard.loadgen.relay.toxiproxy.toxics import Refused, Toxic, attributes

try:
    from fastapi import Depends, FastAPI, Request
    from fastapi.responses import JSONResponse
    from pydantic import BaseModel, BeforeValidator, ConfigDict, TypeAdapter, ValidationError
    from starlette.exceptions import HTTPException
    from starlette.requests import ClientDisconnect
except ImportError as error:
    raise MissingExtra("the relay", "bench") from error

API_VERSION = "2.12.0"  # of Toxiproxy; after it comes "+offboard." and our version
BODY_BYTES_MAX = 64 << 10

T = TypeVar("T")


def toxiproxy_app(proxies: Proxies) -> FastAPI:
    app = FastAPI(title="Toxiproxy's API", dependencies=[Depends(_no_browser)], openapi_url=None)
    app.add_exception_handler(Refused, _refused)
    app.add_exception_handler(HTTPException, _not_here)
    _add_proxies(app, proxies)
    _add_toxics(app, proxies)
    return app


def _add_proxies(app: FastAPI, proxies: Proxies) -> None:
    @app.get("/version")
    async def version() -> dict[str, str]:
        return {"version": f"{API_VERSION}+offboard.{VERSION}"}

    @app.post("/reset", status_code=204)
    async def reset() -> None:
        await proxies.reset()

    @app.get("/proxies")
    async def index() -> dict[str, Any]:
        return proxies.shown()

    @app.post("/proxies", status_code=201)
    async def create(request: Request) -> dict[str, Any]:
        asked = await _read(request, ProxyBody)
        return (await proxies.create(asked.settings())).shown()

    @app.post("/populate", status_code=201)
    async def populate(request: Request) -> dict[str, Any]:
        asked = await _read(request, list[ProxyBody])
        populated = await proxies.populate([proxy.settings() for proxy in asked])
        return {"proxies": [proxy.shown() for proxy in populated]}

    @app.get("/proxies/{name}")
    async def show(name: str) -> dict[str, Any]:
        return proxies.get(name).shown()

    @app.api_route("/proxies/{name}", methods=["POST", "PATCH"])
    async def update(name: str, request: Request) -> dict[str, Any]:
        proxies.get(name)
        changes = await _read(request, ProxyBody)
        return (await proxies.update(name, changes.model_dump(exclude_none=True, exclude={"name"}))).shown()

    @app.delete("/proxies/{name}", status_code=204)
    async def delete(name: str) -> None:
        await proxies.remove(name)


def _add_toxics(app: FastAPI, proxies: Proxies) -> None:
    @app.get("/proxies/{name}/toxics")
    async def index(name: str) -> list[dict[str, Any]]:
        return [toxic.shown() for toxic in proxies.get(name).toxics]

    @app.post("/proxies/{name}/toxics")
    async def create(name: str, request: Request) -> dict[str, Any]:
        proxy = proxies.get(name)
        toxic = (await _read(request, ToxicBody)).toxic()
        proxy.add(toxic)
        return toxic.shown()

    @app.get("/proxies/{name}/toxics/{toxic_name}")
    async def show(name: str, toxic_name: str) -> dict[str, Any]:
        return proxies.get(name).toxic(toxic_name).shown()

    @app.api_route("/proxies/{name}/toxics/{toxic_name}", methods=["POST", "PATCH"])
    async def update(name: str, toxic_name: str, request: Request) -> dict[str, Any]:
        proxy = proxies.get(name)
        proxy.toxic(toxic_name)
        changes = await _read(request, ToxicBody)
        toxic = changes.changed(proxy.toxic(toxic_name))
        proxy.update(toxic)
        return toxic.shown()

    @app.delete("/proxies/{name}/toxics/{toxic_name}", status_code=204)
    async def delete(name: str, toxic_name: str) -> None:
        proxies.get(name).remove(toxic_name)


def _everywhere(listen: Any) -> Any:
    """As in Go, `:PORT` listens on every address."""
    return f"0.0.0.0{listen}" if isinstance(listen, str) and listen.startswith(":") else listen


class Body(BaseModel):
    """A request body. As in Toxiproxy, unknown fields are ignored, and null means left out."""

    model_config = ConfigDict(extra="ignore", strict=True, allow_inf_nan=False)


class ProxyBody(Body):
    """A new proxy, or changes of a proxy."""

    name: str | None = None
    listen: Annotated[str | None, BeforeValidator(_everywhere)] = None
    upstream: str | None = None
    enabled: bool | None = None

    def settings(self) -> ProxySettings:
        return ProxySettings(
            self.name or "", self.listen or LISTEN, self.upstream or "", self.enabled is not False
        )


class ToxicBody(Body):
    """A new toxic, or changes of a toxic."""

    name: str | None = None
    type: str | None = None
    stream: str | None = None
    toxicity: float | None = None
    attributes: dict[str, Any] | None = None

    def toxic(self) -> Toxic:
        stream = "downstream" if self.stream is None else self.stream
        kind = self.type or ""
        name = self.name or f"{kind}_{stream}"
        return Toxic(
            name=name,
            type=kind,
            stream=stream,
            toxicity=self._toxicity(1.0),
            attributes=attributes(kind, self.attributes or {}),
        )

    def changed(self, toxic: Toxic) -> Toxic:
        """The toxic with a new toxicity and new attributes; name, type and stream cannot be changed."""
        new = attributes(toxic.type, self.attributes or {}, toxic.attributes)
        return replace(toxic, toxicity=self._toxicity(toxic.toxicity), attributes=new)

    def _toxicity(self, otherwise: float) -> float:
        return otherwise if self.toxicity is None else self.toxicity


async def _read(request: Request, shape: type[T]) -> T:
    """The body as `shape`. The content type is ignored: curl -d and the Go and Ruby clients send others."""
    body = b""
    try:
        async for chunk in request.stream():
            body += chunk
            if len(body) > BODY_BYTES_MAX:
                raise Refused(f"request body: longer than {BODY_BYTES_MAX} bytes", 413)
        return TypeAdapter(shape).validate_json(body)
    except ClientDisconnect:
        raise Refused("bad request body: the client closed the connection before its end") from None
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise Refused(f"bad request body: {where + ': ' if where else ''}{first['msg']}") from None


async def _no_browser(request: Request) -> None:
    """Refuse browsers, as Toxiproxy does, so that no web page can control the relay."""
    if request.headers.get("user-agent", "").startswith("Mozilla/"):
        raise Refused("User agent not allowed", 403)


async def _refused(_request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, Refused)
    return JSONResponse({"error": str(error), "status": error.status}, error.status)


async def _not_here(_request: Request, error: Exception) -> JSONResponse:
    """Reply to a path or method that the API does not have."""
    assert isinstance(error, HTTPException)
    return JSONResponse({"error": error.detail, "status": error.status_code}, error.status_code)
