"""HTTP middleware: asks for the token, refuses foreign web pages, and adds security headers.

`bounded_http` limits the connections themselves.
"""

import hmac
import json
from collections.abc import Awaitable, Callable, Collection
from typing import Any
from urllib.parse import urlsplit

from offboard.common.security.exposure import on_loopback

_CSP = "default-src 'none'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
# FastAPI's page /docs has an inline script, and loads Swagger from this site.
_CDN, _ICON = "https://cdn.jsdelivr.net", "https://fastapi.tiangolo.com"
_DOCS_CSP = (
    f"{_CSP}; script-src {_CDN} 'unsafe-inline'; style-src {_CDN} 'unsafe-inline'; "
    f"img-src data: {_ICON}; connect-src 'self'"
)
_HEADERS = (
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
    (b"cache-control", b"no-store"),
    (b"referrer-policy", b"no-referrer"),
)

Message = dict[str, Any]
Send = Callable[[Any], Awaitable[None]]
Receive = Callable[[], Awaitable[Any]]


class HttpGuard:
    """ASGI middleware that checks the token, refuses foreign web pages, and adds security headers.

    The app behind it reads `request.state.trusted`: True if the client may see everything.

    Parameters: without a `token` every client is trusted. `open_paths` need no token, but their clients are
    not trusted. Set `loopback` if the server listens on loopback only.
    """

    def __init__(
        self, app: Any, *, token: str | None = None, open_paths: Collection[str] = (), loopback: bool = True
    ) -> None:
        self._app = app
        self._token = None if token is None else token.encode()
        self._open_paths = open_paths
        self._loopback = loopback

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        path, headers = scope["path"], dict(scope["headers"])

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                csp = _DOCS_CSP if path == "/docs" else _CSP
                own = [*_HEADERS, (b"content-security-policy", csp.encode())]
                message = {**message, "headers": [*message.get("headers", ()), *own]}
            await send(message)

        trusted = self._trusts(headers.get(b"authorization", b""))
        if self._from_foreign_page(headers):
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

    def _from_foreign_page(self, headers: dict[bytes, bytes]) -> bool:
        """True if a browser sent this request for a web page of another site.

        Browsers name the page's origin. On loopback without a token the Host header must be this computer
        too: a foreign site can make its own name resolve to 127.0.0.1 (DNS rebinding).
        """
        host = headers.get(b"host")
        origin = headers.get(b"origin")
        if origin is not None and origin.partition(b"://")[2] != host:
            return True
        tokenless = self._loopback and self._token is None
        return tokenless and host is not None and not on_loopback(_name(host.decode("latin-1")))


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
