"""HTTP middleware: asks for the token, refuses foreign web pages, and adds security headers."""

import hmac
import json
from collections.abc import Awaitable, Callable, Collection
from typing import Any
from urllib.parse import urlsplit

from offboard.common.security.address import on_loopback

_CSP = "default-src 'none'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
# Of our own pages. The library for charts sets styles inline, and makes pictures from data.
PAGE_CSP = (
    f"{_CSP}; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data:; connect-src 'self'"
)
HEADERS = {"x-content-type-options": "nosniff", "x-frame-options": "DENY", "referrer-policy": "no-referrer"}
_NO_CACHE = (b"cache-control", b"no-store")

Message = dict[str, Any]
Send = Callable[[Any], Awaitable[None]]
Receive = Callable[[], Awaitable[Any]]


class HttpGuard:
    """ASGI middleware that checks the token, refuses foreign web pages, and adds security headers.

    The app behind it reads `request.state.trusted`: True if the client may see everything.

    Parameters: without a `token` every client is trusted. `open_paths` need no token, but their clients are
    not trusted. `pages` are our own web pages and their files; they hold no data and need no token. Set
    `loopback` if the server listens on loopback only.
    """

    def __init__(
        self,
        app: Any,
        *,
        token: str | None = None,
        open_paths: Collection[str] = (),
        pages: Collection[str] = (),
        loopback: bool = True,
    ) -> None:
        self._app = app
        self._token = None if token is None else token.encode()
        self._open_paths = (*open_paths, *pages)
        self._pages = pages
        self._loopback = loopback

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        path, headers = scope["path"], dict(scope["headers"])

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                given = message.get("headers", ())
                own = {**HEADERS, "content-security-policy": PAGE_CSP if path in self._pages else _CSP}
                added = [(name.encode(), value.encode()) for name, value in own.items()]
                added += () if any(name == _NO_CACHE[0] for name, _ in given) else (_NO_CACHE,)
                message = {**message, "headers": [*given, *added]}
            await send(message)

        trusted = self._trusts(headers.get(b"authorization", b""))
        host, origin = (_text(headers.get(name)) for name in (b"host", b"origin"))
        tokenless = self._loopback and self._token is None
        if from_foreign_page(host, origin, loopback_only=tokenless):
            await _refuse(send_guarded, 403, "requests from other web pages are refused")
        elif not trusted and path not in self._open_paths:
            await _refuse(send_guarded, 401, "send the token in a header: Authorization: Bearer TOKEN")
        else:
            state = {**scope.get("state", {}), "trusted": trusted}
            await self._app({**scope, "state": state}, receive, send_guarded)

    def _trusts(self, authorization: bytes) -> bool:
        scheme, _, token = authorization.partition(b" ")
        if self._token is None:
            return True
        return hmac.compare_digest(token.strip(), self._token) and scheme.lower() == b"bearer"


def from_foreign_page(host: str | None, origin: str | None, *, loopback_only: bool) -> bool:
    """True if a browser sent a request with these headers for a web page of another site.

    Browsers name the page's origin. With `loopback_only` the Host header must be this computer too: a foreign
    site can make its own name resolve to 127.0.0.1 (DNS rebinding).
    """
    if origin is not None and origin.partition("://")[2] != host:
        return True
    return loopback_only and host is not None and not on_loopback(_name(host))


def _text(header: bytes | None) -> str | None:
    return None if header is None else header.decode("latin-1")


def _name(host: str) -> str:
    """The Host header without its port."""
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""


async def _refuse(send: Send, status: int, detail: str) -> None:
    body = json.dumps({"detail": detail}).encode()
    headers = [(b"content-type", b"application/json"), (b"content-length", str(len(body)).encode())]
    if status == 401:
        headers.append((b"www-authenticate", b"Bearer"))
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": body})
