"""Fixtures that make a relay, and the cloud behind it."""

import contextlib
import re
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator

import pytest

from tests.flags import completed
from tests.relays import WAIT_S, WAN, Wan


@pytest.fixture
def cloud() -> Iterator[Callable[[Callable[[socket.socket], None]], int]]:
    """Factory: a TCP server whose connections are given to a function, each in a thread; returns the port."""
    listeners = []
    threads = []

    def serve(talk: Callable[[socket.socket], None]) -> int:
        listener = socket.create_server(("127.0.0.1", 0))
        listeners.append(listener)

        def run(connection: socket.socket) -> None:
            with connection, contextlib.suppress(OSError):
                connection.settimeout(WAIT_S)
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                talk(connection)

        def accept() -> None:
            with contextlib.suppress(OSError):
                while True:
                    threads.append(threading.Thread(target=run, args=(listener.accept()[0],)))
                    threads[-1].start()

        threads.append(threading.Thread(target=accept))
        threads[-1].start()
        return int(listener.getsockname()[1])

    yield serve
    for listener in listeners:
        listener.shutdown(socket.SHUT_RDWR)
        listener.close()
    for thread in threads:
        thread.join(WAIT_S)
        assert not thread.is_alive()


@pytest.fixture
def wan() -> Iterator[Callable[..., Wan]]:
    """Factory: a relay process to a port, with more flags."""
    with contextlib.ExitStack() as stack:

        def start(to: int, *flags: str) -> Wan:
            command = [sys.executable, "-c", WAN, "--to", f"127.0.0.1:{to}"]
            command += completed(flags, listen="127.0.0.1:0", http="127.0.0.1:0")
            process = stack.enter_context(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
            stack.callback(process.kill)
            assert process.stdout is not None
            ports = re.findall(r":(\d+)", process.stdout.readline())
            return Wan(process, int(ports[0]), int(ports[-1]))

        yield start
