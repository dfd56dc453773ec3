"""The ZMQ socket to a server of GR00T: requests and replies in turn, and the end of the connection.

What is sent is decided in `policy_server`, and what it looks like in `groot`.
"""

import asyncio
import contextlib
from collections import deque
from collections.abc import AsyncIterator, Callable
from typing import Any

import zmq
import zmq.asyncio
from zmq.utils.monitor import recv_monitor_message

from offboard.common.errors import CloudBroken
from offboard.robot_client.policy_servers.asyncio_timeout import timeout
from offboard.robot_client.policy_servers.protocol import OPEN_S

BEAT_MS, SILENT_MS = 1000, 5000  # pings of ZMQ, which a server answers even while it computes
WAITING_MAX = 64  # messages that were not sent yet


class GrootSocket:
    """An open connection. The server answers one request after the other, without numbers."""

    def __init__(self, socket: "zmq.asyncio.Socket", ended: "asyncio.Future[str]", ping: bytes) -> None:
        self._socket, self._ended, self._ping = socket, ended, ping
        self._expected: deque[Callable[[], None] | None] = deque()  # by request; None: an observation

    async def receive(self) -> bytes | str:
        while True:
            _, data = await self._or_end(self._socket.recv_multipart())
            answered = self._expected.popleft() if self._expected else None
            if answered is None:
                return bytes(data)
            answered()

    async def send(self, data: bytes) -> None:
        await self._request(data, None)

    async def ping(self, answered: Callable[[], None]) -> None:
        await self._request(self._ping, answered)

    async def _request(self, data: bytes, answered: Callable[[], None] | None) -> None:
        self._expected.append(answered)
        await self._or_end(self._socket.send_multipart([b"", data]))  # the frame that REP expects

    async def _or_end(self, doing: Any) -> Any:
        """The result, or CloudBroken if the connection ends before."""
        task = asyncio.ensure_future(doing)
        try:
            await asyncio.wait([task, self._ended], return_when=asyncio.FIRST_COMPLETED)
            if not task.done():
                raise CloudBroken(self._ended.result())
            frames = task.result()
        except zmq.ZMQError as error:
            raise CloudBroken(str(error)) from error
        finally:
            task.cancel()
        if isinstance(frames, list) and len(frames) != 2:
            raise CloudBroken(f"a reply of {len(frames)} frames; it must have one, after an empty one")
        return frames


@contextlib.asynccontextmanager
async def open_groot_socket(address: str, bytes_max: int, *, ping: bytes) -> AsyncIterator[GrootSocket]:
    """A connection to HOST:PORT, closed at the end. A longer message than `bytes_max` ends it."""
    context = zmq.asyncio.Context()
    socket = context.socket(zmq.DEALER)
    options = {
        zmq.LINGER: 0,
        zmq.IPV6: 1,
        zmq.MAXMSGSIZE: bytes_max,
        zmq.SNDHWM: WAITING_MAX,
        zmq.RCVHWM: WAITING_MAX,
        zmq.HEARTBEAT_IVL: BEAT_MS,
        zmq.HEARTBEAT_TIMEOUT: SILENT_MS,
    }
    for option, value in options.items():
        socket.setsockopt(option, value)
    monitor = socket.get_monitor_socket(zmq.EVENT_HANDSHAKE_SUCCEEDED | zmq.EVENT_DISCONNECTED)
    ended: asyncio.Future[str] = asyncio.get_running_loop().create_future()
    watch = None
    try:
        try:
            socket.connect(f"tcp://{address}")
        except zmq.ZMQError as error:
            raise CloudBroken(f"{address}: {error}") from error
        try:
            async with timeout(OPEN_S):
                await _event(monitor, zmq.EVENT_HANDSHAKE_SUCCEEDED)
        except TimeoutError as error:
            raise CloudBroken("nobody answers there") from error
        watch = asyncio.ensure_future(_watch(monitor, ended))
        yield GrootSocket(socket, ended, ping)
    finally:
        if watch is not None:
            watch.cancel()
            await asyncio.gather(watch, return_exceptions=True)
        socket.disable_monitor()
        monitor.close(0)
        socket.close(0)
        context.term()


async def _watch(monitor: "zmq.asyncio.Socket", ended: "asyncio.Future[str]") -> None:
    await _event(monitor, zmq.EVENT_DISCONNECTED)
    ended.set_result("the server has ended the connection")


async def _event(monitor: "zmq.asyncio.Socket", wanted: int) -> None:
    while True:
        found: Any = await recv_monitor_message(monitor)
        if found["event"] == wanted:
            return
