"""A server with keys in a process of its own, and clients to attack it."""

import contextlib
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import zmq
import zmq.utils.monitor

from offboard.common.wire import messages as wire
from tests.flags import completed

ROOT = Path(__file__).parents[1]
WAIT_S = 20.0
OVER = zmq.EVENT_HANDSHAKE_SUCCEEDED | zmq.EVENT_HANDSHAKE_FAILED_AUTH | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL


def until(condition: Callable[[], Any], within_s: float = WAIT_S) -> float:
    """Wait until another process has done something; returns the seconds that it took."""
    began = time.monotonic()
    while not condition():
        assert time.monotonic() - began < within_s, f"it did not happen within {within_s:g} s"
        time.sleep(0.01)
    return time.monotonic() - began


class Served:
    """`python -m offboard.cloud_server` as a child process, ready once it is constructed.

    `lines` is its log. `files` is its soft limit of open files at the start.
    """

    def __init__(self, *flags: str, files: int | None = None) -> None:
        command = [sys.executable, "-W", "error", "-m", "offboard.cloud_server"]
        free = {"listen": "tcp://127.0.0.1:0", "http": "127.0.0.1:0"}
        command += completed(flags, tasks="tests.probes", workers="2", **free)
        limit = [] if files is None else ["prlimit", f"--nofile={files}:", "--"]
        self.process = subprocess.Popen(
            [*limit, *command],
            stderr=subprocess.PIPE,
            text=True,
            cwd=ROOT,
            env=clean_environ(),
        )
        self.lines: list[str] = []
        self._reader = threading.Thread(target=self._read)
        self._reader.start()
        until(lambda: self.logged(" ready: ") or self.process.poll() is not None)
        assert self.process.poll() is None, self.lines
        ready = next(line for line in self.lines if " ready: " in line)
        endpoint, http = ready.split("listening on ")[1].strip().split(", ")
        self.port = int(endpoint.rpartition(":")[2])
        self.endpoint = f"tcp://127.0.0.1:{self.port}"
        self.http = f"http://127.0.0.1:{http.rpartition(':')[2]}"

    def logged(self, text: str) -> int:
        return sum(text in line for line in self.lines)

    def _read(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self.lines.append(line)

    def close(self) -> None:
        self.process.terminate()
        self.process.wait(WAIT_S)
        self._reader.join(WAIT_S)
        assert self.process.stderr is not None
        self.process.stderr.close()


def clean_environ() -> dict[str, str]:
    return {k: v for k, v in os.environ.items() if not k.startswith(("CLOUD_", "ROBOT_", "WAN_"))}


class Dealer:
    """A raw DEALER socket. `handshake` is the event that ended its handshake."""

    def __init__(self, port: int, public: bytes = b"", secret: bytes = b"", server: bytes = b"") -> None:
        self._context = zmq.Context()
        self.socket = self._context.socket(zmq.DEALER)
        self.socket.linger = 0
        if public:
            self.socket.curve_publickey, self.socket.curve_secretkey = public, secret
            self.socket.curve_serverkey = server
        self.monitor = self.socket.get_monitor_socket(OVER | zmq.EVENT_DISCONNECTED)
        self.socket.connect(f"tcp://127.0.0.1:{port}")
        self.handshake = self.event()

    def event(self, timeout_s: float = WAIT_S) -> int:
        assert self.monitor.poll(int(timeout_s * 1000)), "nothing happened to the connection"
        return int(zmq.utils.monitor.recv_monitor_message(self.monitor)["event"])

    def send(self, message: wire.Message) -> None:
        self.socket.send_multipart(wire.pack(message))

    def receive(self) -> wire.Message:
        assert self.socket.poll(int(WAIT_S * 1000)), "no answer"
        return wire.unpack(self.socket.recv_multipart())

    def __enter__(self) -> "Dealer":
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.disable_monitor()
        self._context.destroy(linger=0)


class Wire:
    """A relay for one connection to the server. `said` is everything that the robot has sent."""

    def __init__(self, port: int) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listener.getsockname()[1])
        self.said = b""
        self._robot: socket.socket | None = None
        self.server = socket.create_connection(("127.0.0.1", port), WAIT_S)
        self._threads = [threading.Thread(target=self._up)]
        self._threads[0].start()

    def _up(self) -> None:
        with contextlib.suppress(OSError):
            robot = self._robot = self._listener.accept()[0]
            self._threads.append(threading.Thread(target=self._down, args=(robot,)))
            self._threads[-1].start()
            while data := robot.recv(65536):
                self.said += data
                self.server.sendall(data)

    def _down(self, robot: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := self.server.recv(65536):
                robot.sendall(data)
            robot.shutdown(socket.SHUT_WR)

    def close(self) -> None:
        ends = [end for end in (self._listener, self._robot, self.server) if end is not None]
        for end in ends:
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            thread.join(WAIT_S)
        for end in ends:
            end.close()


@contextlib.contextmanager
def recorded(port: int) -> Iterator[Wire]:
    way = Wire(port)
    try:
        yield way
    finally:
        way.close()


def says_until_closed(port: int, said: bytes) -> bytes:
    """Send bytes to the server over TCP; returns its answer until it closes the connection."""
    answered = b""
    with socket.create_connection(("127.0.0.1", port), WAIT_S) as client:
        client.sendall(said)
        with contextlib.suppress(ConnectionResetError):
            while data := client.recv(65536):
                answered += data
    return answered
