"""HTTP connections with limits: how long one may take, and how many are open."""

import asyncio
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

REQUEST_S = 10.0  # to begin a request; then, to send the rest of it and to receive its answer
CONNECTIONS_MAX = 256  # open at the same time


class BoundedHttp(H11Protocol):
    """uvicorn's HTTP protocol, hardened against clients that send and read very slowly (Slowloris).

    It closes a connection that is silent for REQUEST_S, and one whose request has no answer within REQUEST_S
    from its first byte. Beyond CONNECTIONS_MAX it closes the connection with the oldest request.
    """

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._limit: asyncio.TimerHandle | None = None
        self._since = 0.0
        self._silent = True  # no byte of the next request has come

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self._limit_time()
        if len(self.connections) > CONNECTIONS_MAX:
            ours = (one for one in self.connections if isinstance(one, BoundedHttp))
            min(ours, key=lambda one: one._since).end()  # that with the oldest last request

    def connection_lost(self, exc: Exception | None) -> None:
        if self._limit is not None:
            self._limit.cancel()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        if self._silent:
            self._silent = False
            self._limit_time()
        super().data_received(data)

    def on_response_complete(self) -> None:
        self._silent = True
        self._limit_time()
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

    def _limit_time(self) -> None:
        self._since = self.loop.time()
        if self._limit is not None:
            self._limit.cancel()
        self._limit = self.loop.call_later(REQUEST_S, self.end)
