"""How a check asks a server: at its name and port below ZMQ, and by messages, one question at a time.

Which questions are asked is decided in `steps`.
"""

import contextlib
import errno
import os
import socket
import time
from collections.abc import Callable, Sequence
from enum import Enum, auto
from typing import Any, TypeVar

from offboard.common import VERSION as SOFTWARE
from offboard.common.errors import ProtocolError
from offboard.common.security.keys import RobotKeys
from offboard.common.wire import messages as wire
from offboard.robot_client.cloud.cloud_socket import MESSAGE_BYTES_MAX, CloudSocket, SocketEvent
from offboard.robot_client.cloud.connection import HandshakeFailure
from offboard.robot_client.sites.runner import CLOUD

# The first bytes of ZMTP 3 (RFC 23): a signature and the version. A server answers with its greeting.
HELLO = b"\xff" + bytes(8) + b"\x7f" + b"\x03\x00"
GREETING_BYTES = 64
MECHANISM = slice(12, 32)  # of the greeting
HTTP_REQUEST = b"GET / HTTP/1.0\r\n\r\n"
HTTP = b"HTTP/"
LOST = (
    "the server closed the connection",
    "look into the log of the server; it may have been stopped, or have cut this robot off",
)
ASK_AGAIN_S = 1.0  # after this time without an answer, `hello` is said again

M = TypeVar("M", bound=wire.Message)


class StepFailed(Exception):
    """A step found something wrong; `remedy` says what the user can do about it."""

    def __init__(self, wrong: str, remedy: str) -> None:
        super().__init__(f"{wrong}; remedy: {remedy}")


class Listener(Enum):
    """What listens on a port."""

    PLAIN = auto()  # a ZMQ server without encryption
    ENCRYPTED = auto()  # a ZMQ server that wants keys
    HTTP = auto()
    OTHER = auto()  # another protocol, or silence
    CLOSING = auto()  # it closes each connection at once


def resolve(host: str, port: int) -> list[str]:
    """An IPv4 and an IPv6 address of the host, if it has both; OSError if its name is not known."""
    found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    first = {family: str(where[0]) for family, *_, where in reversed(found)}
    return [first[family] for family in (socket.AF_INET, socket.AF_INET6) if family in first]


def connect(ips: Sequence[str], port: int, timeout_s: float) -> str:
    """The first IP address that takes a TCP connection; OSError of the last one if none does."""
    *others, last = ips
    for ip in others:
        with contextlib.suppress(OSError):
            return connect([ip], port, timeout_s)
    socket.create_connection((last, port), timeout_s).close()
    return last


def identify(ip: str, port: int, timeout_s: float) -> Listener:
    """What listens on the port; OSError if no connection can be opened."""
    said, closed = _ask(ip, port, timeout_s, HELLO)
    if len(said) == GREETING_BYTES and (said[0], said[9]) == (HELLO[0], HELLO[9]):
        mechanism = said[MECHANISM].rstrip(b"\0")
        return {b"NULL": Listener.PLAIN, b"CURVE": Listener.ENCRYPTED}.get(mechanism, Listener.OTHER)
    # Some HTTP servers refuse the greeting in HTTP, others wait for the end of a line.
    if HTTP in said or HTTP in _ask(ip, port, timeout_s, HTTP_REQUEST)[0]:
        return Listener.HTTP
    return Listener.CLOSING if closed and not said else Listener.OTHER


def reason(error: OSError) -> str:
    """Why the network failed, without the error number."""
    return os.strerror(errno.ETIMEDOUT) if isinstance(error, TimeoutError) else error.strerror or str(error)


def _ask(ip: str, port: int, timeout_s: float, question: bytes) -> tuple[bytes, bool]:
    """Up to GREETING_BYTES of the answer that come within `timeout_s`, and whether the connection ended."""
    said, end_s = b"", time.monotonic() + timeout_s
    with socket.create_connection((ip, port), timeout_s) as opened:
        try:
            opened.sendall(question)
            while len(said) < GREETING_BYTES:
                opened.settimeout(max(0.001, end_s - time.monotonic()))
                data = opened.recv(GREETING_BYTES - len(said))
                if not data:
                    return said, True
                said += data
        except TimeoutError:
            return said, False
        except OSError:  # reset by the listener
            return said, True
    return said, False


class Session:
    """Each method waits up to `timeout_s` for its answer and returns None without one.

    StepFailed if the server closes the connection.
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
            raise StepFailed(*LOST)
        while (left_s := end_s - time.monotonic()) > 0:
            while frames := self._socket.receive():
                answer = _unpack([frame.buffer for frame in frames])
                if isinstance(answer, wanted) and fits(answer):
                    return answer
            if SocketEvent.DISCONNECTED in self._socket.events():
                raise StepFailed(*LOST)
            self._socket.wait(left_s)
        return None


def _unpack(frames: list[Any]) -> wire.Message | None:
    try:
        return wire.unpack(frames)
    except wire.VersionMismatch:
        raise
    except ProtocolError:  # not a message of ours
        return None
