"""What a process asks of whoever reaches it: private files that are private, and a token over HTTP.

The keys of robots and servers are `keys.py`.
"""

import hmac
import ipaddress
import json
import logging
import os
import re
import stat
import threading
from collections.abc import Awaitable, Callable, Collection, Iterable
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from offboard.common.errors import ConfigError

PRIVATE_BYTES_MAX = 64 * 1024  # of a file with a key or a token
TOKEN_CHARS_MIN = 16
INSECURE_WARNING_S = 60.0  # between two warnings of a process that lets anybody in
LOOPBACK = "127.0.0.1, [::1], localhost"
OPEN_REMEDY = f"give it, stay on loopback ({LOOPBACK}), or let anybody in by --insecure"

_TOKEN = re.compile(r"[A-Za-z0-9._~+/=-]+")  # what may stand after `Bearer` (RFC 6750)
_CSP = "default-src 'none'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
# FastAPI's page of the API brings its own script, and Swagger's from here.
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

log = logging.getLogger(__name__)


def on_loopback(host: str) -> bool:
    """Nobody but this computer reaches it; a host name other than localhost counts as reached."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def read_private(where: str, path: Path) -> str:
    """The text of a file that is its owner's alone, or ConfigError in one line."""
    try:
        with path.open("rb") as file:
            mode = stat.S_IMODE(os.fstat(file.fileno()).st_mode)
            if mode & (stat.S_IRWXG | stat.S_IRWXO):
                raise ConfigError(
                    f"{where}: {path} has mode {mode:04o}, so group or others may use it: chmod 600 {path}"
                )
            data = file.read(PRIVATE_BYTES_MAX + 1)
        if len(data) > PRIVATE_BYTES_MAX:
            raise ConfigError(f"{where}: {path} is above {PRIVATE_BYTES_MAX} bytes, the most allowed")
        return data.decode()
    except OSError as error:
        raise ConfigError(f"{where}: {path}: {error.strerror}") from error
    except UnicodeDecodeError:
        raise ConfigError(f"{where}: {path} is not text") from None


def read_token(path: Path | None) -> str | None:
    """The bearer token in the file of --token-file."""
    if path is None:
        return None
    token = read_private("--token-file", path).strip()
    if len(token) < TOKEN_CHARS_MIN or not _TOKEN.fullmatch(token):
        raise ConfigError(
            f"--token-file: {path} must hold one token of at least {TOKEN_CHARS_MIN} characters, "
            "letters, digits and . _ ~ + / = - alone"
        )
    return token


def warn_each_minute(open_ways: Iterable[str]) -> None:
    """Say what is open to anybody, now and again, as long as the process lives."""
    text = f"--insecure: {'; '.join(open_ways)}: whoever reaches this process may use it"

    def warn() -> None:
        again = threading.Event()
        while True:
            log.warning("%s", text)
            again.wait(INSECURE_WARNING_S)

    threading.Thread(target=warn, name="insecure", daemon=True).start()


class Guard:
    """ASGI: a request needs the token, where there is one, unless its path is among `open_paths`.

    Every answer gets security headers. Behind it `request.state.trusted` says whether the asker may see
    everything. Web pages of others are kept out: by the origin that browsers name, and on `loopback`,
    where there may be no token, by the name they were told for this computer.
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
        if self._from_elsewhere(headers):
            await _refuse(send_guarded, 403, "requests of other web pages are refused")
        elif not trusted and path not in self._open_paths:
            await _refuse(send_guarded, 401, "a bearer token is needed: Authorization: Bearer TOKEN")
        else:
            state = {**scope.get("state", {}), "trusted": trusted}
            await self._app({**scope, "state": state}, receive, send_guarded)

    def _trusts(self, authorization: bytes) -> bool:
        scheme, _, token = authorization.partition(b" ")
        if self._token is None:
            return True
        return hmac.compare_digest(token.strip(), self._token) and scheme.lower() == b"bearer"

    def _from_elsewhere(self, headers: dict[bytes, bytes]) -> bool:
        host = headers.get(b"host")
        origin = headers.get(b"origin")
        if origin is not None and origin.partition(b"://")[2] != host:
            return True
        open_here = self._loopback and self._token is None
        return open_here and host is not None and not on_loopback(_name(host.decode("latin-1")))


def _name(host: str) -> str:
    """A Host header without its port."""
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
