"""Requests to a relay with Toxiproxy's API, and connections through its proxies."""

import contextlib
import http.client
import json
import re
import socket
import socketserver
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import toxiproxy

from tests.relays import WAIT_S

WAN = [sys.executable, "-m", "offboard.loadgen", "wan", "--listen", "127.0.0.1:0", "--http", "127.0.0.1:0"]


class Echo(socketserver.BaseRequestHandler):
    """A server that sends every byte back."""

    def handle(self) -> None:
        self.request.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        with contextlib.suppress(OSError):
            while data := self.request.recv(65536):
                self.request.sendall(data)


class Greeter(socketserver.BaseRequestHandler):
    """A server that says hello and closes."""

    def handle(self) -> None:
        self.request.sendall(b"hello")


@contextlib.contextmanager
def running(*flags: str) -> Iterator[int]:
    """Start a relay process, and return the port of its Toxiproxy API."""
    command = [*WAN, "--toxiproxy", "127.0.0.1:0", *flags]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        yield int(re.findall(r":(\d+)", process.stdout.readline())[-1])
        process.terminate()
        assert process.wait(WAIT_S) == 0


def client_of(port: int) -> toxiproxy.Toxiproxy:
    client = toxiproxy.Toxiproxy()
    client.update_api_consumer("127.0.0.1", port)
    return client


def ask(port: int, method: str, path: str, body: Any = None, **headers: str) -> tuple[int, Any]:
    """Send a request without a content type, as some clients do; returns status and body."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=WAIT_S)
    with contextlib.closing(connection):
        text = body if body is None or isinstance(body, str) else json.dumps(body)
        connection.request(method, path, text, headers)
        reply = connection.getresponse()
        data = reply.read()
        return reply.status, json.loads(data) if data else None


def connect(proxy: Any) -> socket.socket:
    host, port = proxy.listen.split(":")
    connection = socket.create_connection((host, int(port)), timeout=WAIT_S)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return connection


def ended(connection: socket.socket) -> bool:
    """Whether the connection ends, with no byte before the end."""
    try:
        return connection.recv(1) == b""
    except ConnectionResetError:
        return True
