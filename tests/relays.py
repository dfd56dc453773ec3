"""A relay in its own process, and functions that send bytes through it."""

import contextlib
import http.client
import json
import socket
import statistics
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

WAN = """
import sys
from offboard.common.command_line import load, run_command
from offboard.loadgen.relay.wan import WanConfig, run_wan
settings = dict(prog="wan", description="", environ={}, prefix="WAN")
sys.exit(run_command("wan", lambda: run_wan(load(WanConfig, sys.argv[1:], **settings))))
"""
WAIT_S = 5.0
PINGS = 15
BATCHES = 10
QUIET_S = 0.15


@dataclass
class Wan:
    """A running relay process, its port, and the port of its control API."""

    process: subprocess.Popen[str]
    port: int
    http_port: int

    def connect(self) -> socket.socket:
        client = socket.create_connection(("127.0.0.1", self.port), timeout=WAIT_S)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return client

    def ask(self, method: str, path: str, body: Any = None) -> tuple[int, Any]:
        connection = http.client.HTTPConnection("127.0.0.1", self.http_port, timeout=WAIT_S)
        with contextlib.closing(connection):
            text = body if isinstance(body, str) else json.dumps(body)
            connection.request(
                method, path, None if body is None else text, {"Content-Type": "application/json"}
            )
            reply = connection.getresponse()
            return reply.status, json.loads(reply.read())

    def change(self, **changes: Any) -> Any:
        status, link = self.ask("PUT", "/link", changes)
        assert status == 200, link
        return link


def echo(connection: socket.socket) -> None:
    while data := connection.recv(65536):
        connection.sendall(data)


def round_trip_s(client: socket.socket) -> float:
    start = time.perf_counter()
    client.sendall(b"ping")
    assert receive(client, 4) == b"ping"
    return time.perf_counter() - start


def quietest(measure: Callable[[], float], batches: int = BATCHES) -> float:
    """The lowest median of several batches, because other load on the machine can only add time."""
    return min(statistics.median(measure() for _ in range(PINGS)) for _ in range(batches))


def receive(client: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size and (part := client.recv(size - len(data))):
        data += part
    return data


def silent(client: socket.socket) -> bool:
    """Whether nothing arrives for QUIET_S, not even the end."""
    client.settimeout(QUIET_S)
    try:
        return client.recv(1) is None
    except TimeoutError:
        return True
    finally:
        client.settimeout(WAIT_S)


def stop(relay: Wan) -> None:
    relay.process.terminate()
    assert relay.process.wait(WAIT_S) == 0


def read_record(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def is_reset(client: socket.socket) -> bool:
    try:
        return client.recv(1) is None
    except ConnectionResetError:
        return True


def wait_until(fact: Callable[[], Any]) -> None:
    end = time.monotonic() + WAIT_S
    while not fact():
        assert time.monotonic() < end, f"not within {WAIT_S} s"
        time.sleep(0.01)
