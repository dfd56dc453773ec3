"""HTTP connections that nobody can hold for nothing: bounded in time and in number."""

import asyncio
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

REQUEST_S = 10.0  # for a request to come in whole, and for its answer to be taken
CONNECTIONS_MAX = 256  # at once; another one takes the place of the one that says nothing for longest


class BoundedHttp(H11Protocol):
    """uvicorn's, against whoever opens connections and says little on them (Slowloris).

    A connection ends that has no request answered for REQUEST_S, however slowly it speaks or reads.
    """

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._limit: asyncio.TimerHandle | None = None
        self._since = 0.0

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self._await_request()
        if len(self.connections) > CONNECTIONS_MAX:
            self._longest().end()

    def connection_lost(self, exc: Exception | None) -> None:
        if self._limit is not None:
            self._limit.cancel()
        super().connection_lost(exc)

    def on_response_complete(self) -> None:
        self._await_request()
        super().on_response_complete()

    def end(self) -> None:
        """At once, without a word."""
        self.connections.discard(self)
        self.transport.abort()

    def _await_request(self) -> None:
        self._since = self.loop.time()
        if self._limit is not None:
            self._limit.cancel()
        self._limit = self.loop.call_later(REQUEST_S, self.end)

    def _longest(self) -> "BoundedHttp":
        """The connection whose last request is longest ago."""
        ours = (one for one in self.connections if isinstance(one, BoundedHttp))
        return min(ours, key=lambda one: one._since)
