"""The files of the pages `/live` and `/docs`: ours, and the library for charts, from plotly's wheel.

`live_port` and `live_pages` send them.
"""

from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from offboard.common.errors import MissingExtra

EXTRA = "live"
LIVE, LOOKS = "/live", "/live/looks"  # the page, and the stream that it reads
CACHE_S = 86_400  # plotly's file is large and does not change while a version is installed

_STATIC = Path(__file__).parent / "static"
_CHARTS = "/live/plotly.js"
_OURS = {
    "/live": ("live.html", "text/html; charset=utf-8"),
    "/live/live.css": ("live.css", "text/css; charset=utf-8"),
    "/live/live.js": ("live.js", "text/javascript; charset=utf-8"),
    "/live/answers.js": ("answers.js", "text/javascript; charset=utf-8"),
    "/live/charts.js": ("charts.js", "text/javascript; charset=utf-8"),
    "/live/memory.js": ("memory.js", "text/javascript; charset=utf-8"),
    "/live/stream.js": ("stream.js", "text/javascript; charset=utf-8"),
    "/docs": ("docs.html", "text/html; charset=utf-8"),
    "/live/docs.js": ("docs.js", "text/javascript; charset=utf-8"),
}
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
    name, content_type = _OURS[path]
    return PageFile(_STATIC / name, content_type, "no-store")


def charts_file() -> Path:
    """The library for charts. Finding it does not import plotly, which takes a second."""
    spec = find_spec("plotly")
    if spec is None or spec.origin is None:
        raise MissingExtra("the page /live", EXTRA)
    return Path(spec.origin).parent / "package_data" / "plotly.min.js"
