"""HTTP connections with limits: how long one may take, and how many are open.

`http_guard` decides which requests are answered.
"""

import asyncio
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

REQUEST_S = 10.0  # to send a request and to receive its answer
CONNECTIONS_MAX = 256  # open at the same time


class BoundedHttp(H11Protocol):
    """uvicorn's HTTP protocol, hardened against clients that send and read very slowly (Slowloris).

    It closes a connection on which no request was answered for REQUEST_S. Beyond CONNECTIONS_MAX it closes
    the connection that has been silent for the longest time.
    """

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._limit: asyncio.TimerHandle | None = None
        self._since = 0.0

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self._await_request()
        if len(self.connections) > CONNECTIONS_MAX:
            self._most_silent().end()

    def connection_lost(self, exc: Exception | None) -> None:
        if self._limit is not None:
            self._limit.cancel()
        super().connection_lost(exc)

    def on_response_complete(self) -> None:
        self._await_request()
        super().on_response_complete()

    def send_400_response(self, msg: str) -> None:
        """Answer 400 to broken bytes. In a body they end the connection: its answer may have begun."""
        if self.conn.our_state is h11.IDLE:
            super().send_400_response(msg)
        else:
            self.cycle.disconnected = True
            self.transport.close()

    def end(self) -> None:
        """Close the connection at once, without an answer."""
        self.connections.discard(self)
        self.transport.abort()

    def _await_request(self) -> None:
        self._since = self.loop.time()
        if self._limit is not None:
            self._limit.cancel()
        self._limit = self.loop.call_later(REQUEST_S, self.end)

    def _most_silent(self) -> "BoundedHttp":
        """The connection with the oldest last request."""
        ours = (one for one in self.connections if isinstance(one, BoundedHttp))
        return min(ours, key=lambda one: one._since)
