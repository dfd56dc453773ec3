"""The files of the pages `/live` and `/docs`: ours, and the library for charts, from plotly's wheel.

`live_port` sends them for a robot, and the middleware here for the HTTP APIs of server and relay.
`http_guard`, which is in front of it, adds the security headers.
"""

import re
from collections.abc import Awaitable, Callable, Collection
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from offboard.common.errors import MissingExtra

EXTRA = "live"
LIVE, LOOKS = "/live", "/live/looks"  # the page, and the stream that it reads
CACHE_S = 86_400  # plotly's file is large and does not change while a version is installed

_STATIC = Path(__file__).parent / "static"
_CHARTS = "/live/plotly.js"
_NAMES = ("live.css", "live.js", "answers.js", "charts.js", "memory.js", "stream.js", "docs.js")
_OURS = {"/live": "live.html", "/docs": "docs.html"} | {f"/live/{name}": name for name in _NAMES}
_TYPES = {".html": "text/html", ".css": "text/css", ".js": "text/javascript"}
PATHS = (*_OURS, _CHARTS)  # they hold no data, so they need no token
DOCS_PATHS = ("/docs", "/live/docs.js", "/live/live.css", "/live/stream.js")  # those of /docs alone


@dataclass(frozen=True, slots=True)
class PageFile:
    """A file of a page, with its HTTP headers."""

    path: Path
    content_type: str
    cache: str

    @property
    def headers(self) -> dict[str, str]:
        return {"content-type": self.content_type, "cache-control": self.cache}


def page_file(path: str) -> PageFile:
    """The file at one of PATHS. MissingExtra if it needs plotly, which is not installed."""
    if path == _CHARTS:
        cache = f"private, max-age={CACHE_S}"
        return PageFile(charts_file(), "text/javascript; charset=utf-8", cache)
    if path == LIVE:
        charts_file()
    file = _STATIC / _OURS[path]
    return PageFile(file, f"{_TYPES[file.suffix]}; charset=utf-8", "no-store")


def charts_file() -> Path:
    """The library for charts. Finding it does not import plotly, which takes a second."""
    spec = find_spec("plotly")
    if spec is None or spec.origin is None:
        raise MissingExtra("the page /live", EXTRA)
    return Path(spec.origin).parent / "package_data" / "plotly.min.js"


def colours() -> dict[str, str]:
    """The colours of the light page, by their names in `live.css`. All charts and pictures have these."""
    found: dict[str, str] = {}
    for name, colour in re.findall(r"--([\w-]+): (#\w+);", page_file("/live/live.css").path.read_text()):
        found.setdefault(name, colour)  # the first block is for a light page
    return found


Message = dict[str, Any]


class LivePages:
    """Answers GET of `paths`, which are some of `live_files.PATHS`. The app behind it answers all else."""

    def __init__(self, app: Any, *, paths: Collection[str]) -> None:
        self._app = app
        self._paths = paths

    async def __call__(
        self, scope: Message, receive: Callable[[], Awaitable[Any]], send: Callable[[Any], Awaitable[None]]
    ) -> None:
        if scope["type"] != "http" or scope["method"] != "GET" or scope["path"] not in self._paths:
            await self._app(scope, receive, send)
            return
        try:
            file = page_file(scope["path"])
            status, headers, body = 200, file.headers, file.path.read_bytes()
        except MissingExtra as missing:
            status, headers = 501, {"content-type": "text/plain; charset=utf-8"}
            body = f"{missing}\n".encode()
        headers = {**headers, "content-length": str(len(body))}
        raw = [(name.encode(), value.encode()) for name, value in headers.items()]
        await send({"type": "http.response.start", "status": status, "headers": raw})
        await send({"type": "http.response.body", "body": body})
