"""The WebSocket to a policy server: how it is opened, what it carries, and how it ends.

Only this file imports `websockets`, and translates its errors. What is sent is decided in `policy_server`.
"""

import asyncio
import contextlib
import socket
from collections.abc import AsyncIterator, Callable, Iterator

from offboard.common.errors import CloudBroken, MissingExtra
from offboard.robot_client.cloud import cloud_socket
from offboard.robot_client.policy_servers.asyncio_timeout import timeout
from offboard.robot_client.policy_servers.protocol import OPEN_S

try:
    from websockets.asyncio.client import ClientConnection, connect
    from websockets.exceptions import WebSocketException
except ImportError as error:
    raise MissingExtra("a policy server (ws:// or wss://)", "openpi") from error

CLOSE_S = 0.5  # for the server to answer a close
MESSAGES_MAX = 4  # frames that have come and were not read yet

# The kernel ends the connection if the computer of the server vanished without a word.
_OPTIONS = {
    "TCP_USER_TIMEOUT": cloud_socket.UNACKNOWLEDGED_MS,
    "TCP_KEEPIDLE": cloud_socket.KEEPALIVE_IDLE_S,
    "TCP_KEEPINTVL": cloud_socket.KEEPALIVE_EVERY_S,
    "TCP_KEEPCNT": cloud_socket.KEEPALIVE_PROBES,
}


class WebSocket:
    """An open connection. Each method raises CloudBroken once the connection has ended."""

    def __init__(self, connection: ClientConnection) -> None:
        self._connection = connection

    async def receive(self) -> bytes | str:
        """The next message; a text, if the server sent a text."""
        with _translated():
            return await self._connection.recv()

    async def send(self, data: bytes) -> None:
        """Send a message. Returns when nearly all of it is with the kernel."""
        with _translated():
            await self._connection.send(data)

    async def ping(self, answered: Callable[[], None]) -> None:
        """Send a ping; `answered` is called if its answer comes."""

        def done(pong: "asyncio.Future[float]") -> None:
            if not pong.cancelled() and pong.exception() is None:
                answered()

        with _translated():
            asyncio.ensure_future(await self._connection.ping()).add_done_callback(done)


@contextlib.asynccontextmanager
async def open_web_socket(
    endpoint: str, bytes_max: int, *, authorization: str | None = None
) -> AsyncIterator[WebSocket]:
    """A connection to the server, closed at the end. A longer message than `bytes_max` ends it.

    The library sends no pings of its own: most policy servers compute in the thread that would answer them.
    """
    with _translated():
        connection = await connect(
            endpoint,
            additional_headers=None if authorization is None else {"Authorization": authorization},
            compression=None,
            proxy=None,
            open_timeout=OPEN_S,
            ping_interval=None,
            close_timeout=CLOSE_S,
            max_size=bytes_max,
            max_queue=MESSAGES_MAX,
        )
    try:
        _set_options(connection)
        yield WebSocket(connection)
    finally:
        await _close(connection)


async def _close(connection: ClientConnection) -> None:
    try:
        with contextlib.suppress(OSError):  # TimeoutError is one
            async with timeout(CLOSE_S):
                await connection.close()
    finally:  # also if the runner is closed meanwhile
        connection.transport.abort()
    await connection.wait_closed()


def _set_options(connection: ClientConnection) -> None:
    raw = connection.transport.get_extra_info("socket")
    raw.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in _OPTIONS.items():
        if hasattr(socket, name):  # some systems lack some of them
            raw.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)


@contextlib.contextmanager
def _translated() -> Iterator[None]:
    try:
        yield
    except (WebSocketException, OSError, asyncio.TimeoutError, UnicodeError) as error:
        # UnicodeError: no name of a host. asyncio.TimeoutError: in Python 3.10, it is no OSError.
        raise CloudBroken(str(error) or type(error).__name__) from error
