"""Broken HTTP requests: each is answered or cut off, and none leaves a traceback in the log."""

import contextlib
import logging
import random
import socket
import time
from collections.abc import Iterator, Sequence

import pytest
from prometheus_client import CollectorRegistry

from offboard.cloud_server.http_api import HttpServer, create_app
from offboard.cloud_server.metrics import Status

pytestmark = pytest.mark.integration

WAIT_S = 0.02  # between two parts of a request, so that the server reads them one by one
MUTATED = 100
HOST = b"Host: localhost\r\n"
CHUNKED = b"POST /health HTTP/1.1\r\n" + HOST + b"Transfer-Encoding: chunked\r\n\r\n"
GET = b"GET /health HTTP/1.1\r\n" + HOST
UPGRADE = GET + b"Upgrade: websocket\r\nConnection: Upgrade\r\n"
BROKEN: tuple[tuple[bytes, ...], ...] = (
    (b"garbage\r\n\r\n",),
    (b"\x16\x03\x01\x02\x00",),
    (b"GET / HTTP/9.9\r\n\r\n",),
    (b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",),
    (GET + b"\r\ngarbage\r\n\r\n",),
    (GET + b"\r\n", b"garbage\r\n\r\n"),
    (GET + b"Content-Length: x\r\n\r\n",),
    (GET + b"Content-Length: 5\r\nContent-Length: 6\r\n\r\nhello",),
    (GET + b"Transfer-Encoding: gzip\r\n\r\n",),
    (CHUNKED + b"zz\r\n",),
    (CHUNKED, b"zz\r\n"),
    (CHUNKED, b"5\r\nhello", b"zz\r\n"),
    (GET + b"Expect: 100-continue\r\nContent-Length: 5\r\n\r\n", b"he", b"llogarbage"),
    (UPGRADE + b"\r\n", b"\xff\xff"),
    (UPGRADE + b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 99\r\n\r\n",),
    (b"GET /health/ HTTP/1.1\r\nHost: [\r\n\r\n",),
    (b"GET /%ff%00/ HTTP/1.1\r\nHost: \xff\r\n\r\n",),
    (b"CONNECT localhost:80 HTTP/1.1\r\n" + HOST + b"\r\n", b"garbage\r\n"),
    (b"GET /health HTTP/1.0\r\n\r\ngarbage",),
    (GET + b"Connection: close\r\n\r\ngarbage", b"garbage"),
    (GET + b"A: " + b"x" * 100_000 + b"\r\n\r\n",),
    (GET + b"Authorization: Bearer \xff\r\nOrigin: \xff\r\n\r\n",),
)


def status() -> Status:
    return Status(
        ready=True,
        draining=False,
        queue_depth=0,
        running=0,
        executor="threads",
        places={"localhost": 1},
        uptime_s=0.0,
        last_turn_age_s=0.0,
        last_task_age_s=None,
    )


@pytest.fixture(params=[{}, {"token": "t" * 20, "loopback": False}, {"loopback": False, "insecure": True}])
def port(request: pytest.FixtureRequest) -> Iterator[int]:
    """The port of a server on loopback, with the access rules of the parameters."""
    app = create_app(status, CollectorRegistry(), {}, **request.param)
    with contextlib.closing(HttpServer(app, ("127.0.0.1", 0))) as server:
        server.start()
        yield int(server.address.rpartition(":")[2])


def ask(port: int, parts: Sequence[bytes]) -> bytes:
    """Send the parts one by one; return what came back, which may be nothing."""
    with socket.create_connection(("127.0.0.1", port), timeout=5) as connection, contextlib.suppress(OSError):
        for part in parts:
            connection.sendall(part)
            time.sleep(WAIT_S)
        connection.shutdown(socket.SHUT_WR)
        return connection.recv(1000)
    return b""


def mutated(rng: random.Random) -> tuple[bytes, ...]:
    """One of the requests with some bytes changed, left out or added, cut in two."""
    text = bytearray(b"".join(rng.choice(BROKEN))[:600])
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(len(text))
        added = rng.choice((b"\r\n", b"\r\n\r\n", b":", b"\xff", b"0\r\n\r\n", GET + b"\r\n"))
        text[at : at + rng.randint(0, 3)] = rng.choice((added, bytes([rng.randrange(256)])))
    cut = rng.randrange(len(text))
    return bytes(text[:cut]), bytes(text[cut:])


def test_a_broken_request_leaves_no_traceback(port: int, caplog: pytest.LogCaptureFixture) -> None:
    """The log stays empty, and the next request is answered."""
    rng = random.Random(1)
    with caplog.at_level(logging.INFO):
        for parts in (*BROKEN, *(mutated(rng) for _ in range(MUTATED))):
            ask(port, parts)
            logged = [one.getMessage() for one in caplog.records]
            assert logged == [], parts
        assert ask(port, [GET + b"\r\n"]).startswith(b"HTTP/1.1 200 ")


def test_a_request_that_is_no_http_is_answered_400(port: int) -> None:
    """Only a request whose body breaks off has another answer, which has begun."""
    assert ask(port, [b"garbage\r\n\r\n"]).startswith(b"HTTP/1.1 400 ")
    assert ask(port, [CHUNKED, b"zz\r\n"]).startswith((b"HTTP/1.1 405 ", b"HTTP/1.1 401 "))
