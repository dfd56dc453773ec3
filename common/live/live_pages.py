"""ASGI middleware that sends the files of our pages, for the HTTP APIs of server and relay.

`live_files` knows the files, and `http_guard`, which is in front of this, adds the security headers.
"""

from collections.abc import Awaitable, Callable, Collection
from typing import Any

from offboard.common.errors import MissingExtra
from offboard.common.live.live_files import page_file

Message = dict[str, Any]


class LivePages:
    """Answers GET of `paths`, which are some of `live_files.PATHS`. The app behind it answers all else."""

    def __init__(self, app: Any, *, paths: Collection[str]) -> None:
        self._app = app
        self._paths = paths

    async def __call__(
        self,
        scope: Message,
        receive: Callable[[], Awaitable[Any]],
        send: Callable[[Any], Awaitable[None]],
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
