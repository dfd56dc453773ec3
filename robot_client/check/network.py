"""The network below ZMQ: resolves the name of a server, connects to its port, and says what listens there.

What is said over ZMQ is in `session`.
"""

import contextlib
import errno
import os
import socket
import time
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum, auto

# The first bytes of ZMTP 3 (RFC 23): a signature and the version. A server answers with its greeting.
HELLO = b"\xff" + bytes(8) + b"\x7f" + b"\x03\x00"
GREETING_BYTES = 64
MECHANISM = slice(12, 32)  # of the greeting
HTTP_REQUEST = b"GET / HTTP/1.0\r\n\r\n"
HTTP = b"HTTP/"


class Listener(Enum):
    """What listens on a port."""

    PLAIN = auto()  # a ZMQ server without encryption
    ENCRYPTED = auto()  # a ZMQ server that wants keys
    HTTP = auto()
    OTHER = auto()  # another protocol, or silence
    CLOSING = auto()  # it closes each connection at once


@dataclass(frozen=True, slots=True)
class Address:
    """The parts of tcp://HOST:PORT."""

    host: str
    port: int

    @classmethod
    def of(cls, endpoint: str) -> "Address":
        host, _, port = endpoint.removeprefix("tcp://").rpartition(":")
        return cls(host.strip("[]"), int(port))


def resolve(address: Address) -> list[str]:
    """An IPv4 and an IPv6 address of the host, if it has both; OSError if its name is not known."""
    found = socket.getaddrinfo(address.host, address.port, type=socket.SOCK_STREAM)
    first = {family: str(where[0]) for family, *_, where in reversed(found)}
    return [first[family] for family in (socket.AF_INET, socket.AF_INET6) if family in first]


def connect(ips: Sequence[str], address: Address, timeout_s: float) -> str:
    """The first IP address that takes a TCP connection; OSError of the last one if none does."""
    *others, last = ips
    for ip in others:
        with contextlib.suppress(OSError):
            return connect([ip], address, timeout_s)
    socket.create_connection((last, address.port), timeout_s).close()
    return last


def identify(ip: str, address: Address, timeout_s: float) -> Listener:
    """What listens on the port; OSError if no connection can be opened."""
    greeting = _ask(ip, address, timeout_s, HELLO)
    if len(greeting.said) == GREETING_BYTES and (greeting.said[0], greeting.said[9]) == (HELLO[0], HELLO[9]):
        mechanism = greeting.said[MECHANISM].rstrip(b"\0")
        return {b"NULL": Listener.PLAIN, b"CURVE": Listener.ENCRYPTED}.get(mechanism, Listener.OTHER)
    # Some HTTP servers refuse the greeting in HTTP, others wait for the end of a line.
    if HTTP in greeting.said or HTTP in _ask(ip, address, timeout_s, HTTP_REQUEST).said:
        return Listener.HTTP
    return Listener.CLOSING if greeting.closed and not greeting.said else Listener.OTHER


def reason(error: OSError) -> str:
    """Why the network failed, without the error number."""
    return os.strerror(errno.ETIMEDOUT) if isinstance(error, TimeoutError) else error.strerror or str(error)


@dataclass(frozen=True, slots=True)
class _Answer:
    """What a listener said, and whether it then closed the connection."""

    said: bytes
    closed: bool


def _ask(ip: str, address: Address, timeout_s: float, question: bytes) -> _Answer:
    """Up to GREETING_BYTES of the answer, as far as they come within `timeout_s`."""
    said, end_s = b"", time.monotonic() + timeout_s
    with socket.create_connection((ip, address.port), timeout_s) as opened:
        try:
            opened.sendall(question)
            while len(said) < GREETING_BYTES:
                opened.settimeout(max(0.001, end_s - time.monotonic()))
                data = opened.recv(GREETING_BYTES - len(said))
                if not data:
                    return _Answer(said, closed=True)
                said += data
        except TimeoutError:
            return _Answer(said, closed=False)
        except OSError:  # reset by the listener
            return _Answer(said, closed=True)
    return _Answer(said, closed=False)
