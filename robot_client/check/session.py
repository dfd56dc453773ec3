"""A connection to one server that asks one question at a time and waits for its answer.

The messages are those of `wire.messages`; which questions are asked is decided in `steps`.
"""

import time
from collections.abc import Callable
from typing import Any, TypeVar

from offboard.common import VERSION as SOFTWARE
from offboard.common.errors import ProtocolError
from offboard.common.security.keys import RobotKeys
from offboard.common.wire import messages as wire
from offboard.robot_client.sites.cloud_socket import MESSAGE_BYTES_MAX, CloudSocket, SocketEvent
from offboard.robot_client.sites.connection import HandshakeFailure
from offboard.robot_client.sites.runner import CLOUD

ASK_AGAIN_S = 1.0  # after this time without an answer, `hello` is said again

M = TypeVar("M", bound=wire.Message)


class ConnectionLost(Exception):
    """The server closed the connection."""


class Session:
    """Each method waits up to `timeout_s` for its answer and returns None without one.

    All of them may raise ConnectionLost.
    """

    def __init__(self, endpoint: str, keys: RobotKeys | None, timeout_s: float) -> None:
        self._timeout_s = timeout_s
        self._socket = CloudSocket(CLOUD, endpoint, keys)

    def handshake(self) -> SocketEvent | HandshakeFailure | None:
        """How the first handshake ended."""
        end_s = time.monotonic() + self._timeout_s
        while (left_s := end_s - time.monotonic()) > 0:
            for event in self._socket.events():
                return event
            self._socket.wait(left_s)
        return None

    def hello(self, tasks: dict[str, str]) -> wire.Hello | None:
        """The answer to `hello`; VersionMismatch if the server speaks another version."""
        hello, end_s = wire.Hello(tasks, SOFTWARE, MESSAGE_BYTES_MAX), time.monotonic() + self._timeout_s
        while (left_s := end_s - time.monotonic()) > 0:
            answer = self._ask(hello, wire.Hello, lambda _: True, min(ASK_AGAIN_S, left_s))
            if answer is not None:
                return answer
        return None

    def ping(self, number: int) -> float | None:
        """The round trip of one ping, in seconds; `number` must be new."""
        began_s = time.perf_counter()
        pong = self._ask(wire.Ping(number), wire.Pong, lambda pong: pong.id == number, self._timeout_s)
        return None if pong is None else time.perf_counter() - began_s

    def run(self, kind: str) -> wire.Reply | None:
        """The reply to a request of a task without arguments."""
        body = wire.encode([], ()).frames
        request = wire.Request(1, kind, self._timeout_s, body=body)
        return self._ask(request, wire.Reply, lambda reply: reply.id == request.id, self._timeout_s)

    def close(self) -> None:
        self._socket.close()

    def _ask(
        self, question: wire.Message, wanted: type[M], fits: Callable[[M], bool], timeout_s: float
    ) -> M | None:
        end_s = time.monotonic() + timeout_s
        if not self._socket.try_send(wire.pack(question)):
            raise ConnectionLost
        while (left_s := end_s - time.monotonic()) > 0:
            while frames := self._socket.receive():
                answer = _unpack([frame.buffer for frame in frames])
                if isinstance(answer, wanted) and fits(answer):
                    return answer
            if SocketEvent.DISCONNECTED in self._socket.events():
                raise ConnectionLost
            self._socket.wait(left_s)
        return None


def _unpack(frames: list[Any]) -> wire.Message | None:
    try:
        return wire.unpack(frames)
    except wire.VersionMismatch:
        raise
    except ProtocolError:  # not a message of ours
        return None
