"""Attacks by connections: failing handshakes, endless frames, and connections that are slow or idle."""

import contextlib
import random
import socket
import struct
import tempfile
import time
from collections.abc import Generator, Iterator
from pathlib import Path

import zmq

from benchmarks.attack_target import SEND_S, Target, prepare
from offboard.common.security.keys import ROBOT, make_keys

CONNECTIONS = 200  # of the slow attacker
IDLE = 5_000  # connections of the idle attacker
PART_BYTES = 1 << 20
SEED = 1
PLAIN_GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + bytes(32)  # ZMTP 3.0
READY = b"\x04\x1c\x05READY\x0bSocket-Type\x00\x00\x00\x06DEALER"


def claims(target: Target) -> Generator[None]:
    """Frames that claim to have 4 GB, before and after the handshake."""
    huge = struct.pack(">BQ", 0x02, 2**32)  # a long frame
    command = struct.pack(">BQ", 0x06, 2**32)
    while True:
        for said in (PLAIN_GREETING + READY + huge, PLAIN_GREETING + command, curve_greeting() + command):
            with (
                contextlib.suppress(OSError),
                socket.create_connection(("127.0.0.1", target.port), 1.0) as raw,
            ):
                raw.sendall(said)
                raw.sendall(bytes(1 << 16))
            yield


def curve_greeting() -> bytes:
    return PLAIN_GREETING.replace(b"NULL".ljust(20, b"\0"), b"CURVE".ljust(20, b"\0"))


def endless(target: Target) -> Generator[None]:
    """One message that never ends, in frames of an allowed size, without encryption.

    libzmq only sends complete messages, so this speaks ZMTP itself.
    """
    part = struct.pack(">BQ", 0x03, PART_BYTES) + bytes(PART_BYTES)  # a long frame, with more to come
    while True:
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", target.port), 1.0) as raw:
            raw.sendall(PLAIN_GREETING + READY)
            while True:
                raw.sendall(part)
                yield
        yield


def strangers(target: Target) -> Generator[None]:
    """Handshakes without a key, with an unknown key, and without encryption."""
    with tempfile.TemporaryDirectory() as folder:
        unknown = Path(folder) / "unknown"
        make_keys(unknown, ROBOT)
        if target.keys is not None:
            (unknown / "server.key").write_bytes((target.keys / "server.key").read_bytes())
        while True:
            with zmq.Context() as context:
                for keys in (unknown if target.keys else None, None):
                    with context.socket(zmq.DEALER) as client:
                        prepare(client, keys)
                        client.connect(target.endpoint)
                        client.send(b"hello")
                        client.poll(int(SEND_S * 1000))
                        yield


def slow(target: Target) -> Generator[None]:
    """Many connections to both ports, which send a byte now and then and never a complete message."""
    http = b"GET /health HTTP/1.1\r\nHost: 127.0.0.1\r\nX: " + b"x" * 4096
    said = {target.port: PLAIN_GREETING + READY, target.http_port: http}
    open_: dict[socket.socket, Iterator[int]] = {}
    try:
        while True:
            for port, text in said.items():
                if len(open_) < 2 * CONNECTIONS:
                    with contextlib.suppress(OSError):
                        open_[socket.create_connection(("127.0.0.1", port), 1.0)] = iter(text)
            for client, rest in list(open_.items()):
                try:
                    client.sendall(bytes([next(rest)]))
                except (OSError, StopIteration):
                    del open_[client]
                    client.close()
            time.sleep(0.01)
            yield
    finally:
        for client in open_:
            client.close()


def idle(target: Target) -> Generator[None]:
    """Many connections with a known key that send nothing."""
    context = zmq.Context()
    context.set(zmq.MAX_SOCKETS, IDLE + 10)
    clients = []
    try:
        for _ in range(IDLE):
            client = context.socket(zmq.DEALER)
            prepare(client, target.keys)
            client.connect(target.endpoint)
            clients.append(client)
            yield
        while True:
            time.sleep(0.01)
            yield
    finally:
        context.destroy(linger=0)


def http(target: Target) -> Generator[None]:
    """HTTP requests that are malformed or far too long."""
    rng = random.Random(SEED)
    lines = (
        b"GET /../../etc/passwd HTTP/1.1\r\nHost: x\r\n\r\n",
        b"GET / HTTP/9.9\r\n\r\n",
        b"POST /health HTTP/1.1\r\nHost: x\r\nContent-Length: 99999999999\r\n\r\n",
        b"GET /" + b"a" * 100_000,
        b"\x16\x03\x01\x02\x00",
    )
    while True:
        said = rng.choice((*lines, rng.randbytes(2_000)))
        with (
            contextlib.suppress(OSError),
            socket.create_connection(("127.0.0.1", target.http_port), 1.0) as raw,
        ):
            raw.sendall(said)
        yield
