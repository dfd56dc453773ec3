"""The speed of large messages through the relay, compared to plain loopback in the same run."""

import contextlib
import socket
import statistics
import time
from typing import Any

import pytest

pytestmark = pytest.mark.integration

BLOB_BYTES = 4 << 20
BLOBS = 10  # a round
ROUNDS = 5
LEAST_SHARE = 0.25


def sink(connection: socket.socket) -> None:
    """Answers every blob with one byte."""
    memory = memoryview(bytearray(1 << 20))
    while True:
        left = BLOB_BYTES
        while left:
            taken = connection.recv_into(memory, min(left, len(memory)))
            if not taken:
                return
            left -= taken
        connection.sendall(b"k")


def blob_s(client: socket.socket, blob: bytes) -> float:
    start = time.perf_counter()
    client.sendall(blob)
    assert client.recv(1) == b"k"
    return time.perf_counter() - start


def test_large_messages_are_fast(cloud: Any, wan: Any) -> None:
    """Without conditions, blobs of 4 MB have at least a quarter of the speed of plain loopback.

    Both are measured in turns, so that other load on the machine affects both.
    """
    port = cloud(sink)
    relay = wan(port, "--delay-ms", "0", "--bandwidth-mbps", "0")
    blob = bytes(BLOB_BYTES)
    rounds: dict[str, list[float]] = {"direct": [], "relay": []}
    with contextlib.ExitStack() as stack:
        clients = {
            "direct": stack.enter_context(socket.create_connection(("127.0.0.1", port))),
            "relay": stack.enter_context(relay.connect()),
        }
        for _ in range(ROUNDS):
            for name, client in clients.items():
                rounds[name].append(statistics.median(blob_s(client, blob) for _ in range(BLOBS)))
    direct_s, relay_s = (statistics.median(rounds[name]) for name in ("direct", "relay"))
    print(f"4 MB: direct {1e3 * direct_s:.2f} ms, relay {1e3 * relay_s:.2f} ms, {direct_s / relay_s:.0%}")
    assert direct_s / relay_s >= LEAST_SHARE
