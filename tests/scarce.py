"""A process that runs out of files or threads; a script that prints what happened as JSON.

`python -m tests.scarce connect|serve files|threads` makes offloaders or servers with 0, 1, 2, .. of them
left. `python -m tests.scarce large` sends a large argument without a file left. `python -m tests.scarce
reconnect` loses its server, and has no file left to connect again.
"""

import json
import os
import resource
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path

import numpy as np

from offboard.cloud_server.executors import EXECUTORS
from offboard.cloud_server.metrics import Metrics
from offboard.cloud_server.server import Limits, Server
from offboard.common.errors import OffloadError
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.sites.runner import CLOUD
from tests.cables import START_S, used, wait_for_cloud
from tests.probes import total

FILES_MAX = 128
FILES_TRIED, THREADS_TRIED = 32, 12
THREAD_BYTES = resource.getrlimit(resource.RLIMIT_STACK)[0] + (1 << 16)
SPARE_BYTES = 4 << 20
MIB = 1 << 20
ATTEMPT_S = 1.5  # after which libzmq has closed the file of an attempt to connect that was under way
AWAY_S = 3.0  # longer than the pauses between attempts to connect
NOTHING_THERE = "tcp://127.0.0.1:9"
WAITING_SERVER = 'read _; exec "$0" -m offboard.cloud_server "$@"'


@contextmanager
def files_left(count: int, *, watch_s: float = 0.0) -> Iterator[None]:
    """All files but `count` are open, also those that libzmq closes within this time."""
    held: list[int] = []
    end_s = time.monotonic() + watch_s
    while take_files(held) or time.monotonic() < end_s:
        time.sleep(0.001)
    for _ in range(count):
        os.close(held.pop())
    try:
        yield
    finally:
        for file in held:
            os.close(file)


def take_files(held: list[int]) -> bool:
    """Open all files that are left. Whether there were any."""
    before = len(held)
    with suppress(OSError):
        while True:
            held.append(os.open(os.devnull, os.O_RDONLY))
    return len(held) > before


@contextmanager
def threads_left(count: int) -> Iterator[None]:
    """Address space is left for the stacks of `count` threads."""
    taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    limit = taken + SPARE_BYTES + count * THREAD_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, resource.RLIM_INFINITY))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))


def connect() -> Callable[[], object]:
    return Offloader.connect(NOTHING_THERE, policy=CLOUD).close


def serve() -> Callable[[], object]:
    limits = Limits(64, MIB, MIB, MIB, 1.0)
    server = Server("tcp://127.0.0.1:*", EXECUTORS["threads"](1, [], MIB, MIB), Metrics(), limits)
    server.drain()
    return server.run


def outcome(make: Callable[[], Callable[[], object]], scarcity: AbstractContextManager[None]) -> str:
    try:
        with scarcity:
            end = make()
    except OffloadError as error:
        return str(error)
    end()
    return "made"


@contextmanager
def two_servers() -> Iterator[tuple[str, list["subprocess.Popen[bytes]"]]]:
    """An endpoint, and two processes that become its server when `start` is called."""
    with socket.create_server(("127.0.0.1", 0)) as unused:
        endpoint = f"tcp://127.0.0.1:{unused.getsockname()[1]}"
    flags = ["--listen", endpoint, "--tasks", "tests.probes", "--http", "127.0.0.1:0"]
    command = ["sh", "-c", WAITING_SERVER, sys.executable, *flags]
    servers = [subprocess.Popen(command, stdin=subprocess.PIPE, stdout=sys.stderr) for _ in range(2)]
    try:
        yield endpoint, servers
    finally:
        for server in servers:
            server.kill()


def large() -> str:
    """Send an argument that is not copied."""
    with two_servers() as (endpoint, servers):
        start(servers[0])
        with Offloader.connect(endpoint, policy=CLOUD, timeout_s=5.0) as offload:
            wait_for_cloud(offload, START_S)
            with files_left(0):
                assert offload(total, np.ones(100_000)) == 100_000.0
            assert offload.last is not None
            return str(offload.last.used)


def reconnect() -> str:
    """Lose the server, and start another one on its port while no file is left."""
    with two_servers() as (endpoint, servers):
        start(servers[0])
        with Offloader.connect(endpoint, policy=CLOUD, timeout_s=2.0) as offload:
            wait_for_cloud(offload, START_S)
            servers[0].kill()
            while used(offload) == CLOUD:
                pass
            with files_left(0, watch_s=ATTEMPT_S):
                start(servers[1])
                end_s = time.monotonic() + AWAY_S
                while time.monotonic() < end_s:
                    assert used(offload) != CLOUD
            wait_for_cloud(offload, START_S)
            return "used again"


def start(server: "subprocess.Popen[bytes]") -> None:
    assert server.stdin is not None
    os.write(server.stdin.fileno(), b"\n")


def main(what: str, scarce: str = "files") -> object:
    resource.setrlimit(resource.RLIMIT_NOFILE, (FILES_MAX, FILES_MAX))
    if what in ("large", "reconnect"):
        return {"large": large, "reconnect": reconnect}[what]()
    make = {"connect": connect, "serve": serve}[what]
    make()()  # opens what stays open
    left, tried = {"files": (files_left, FILES_TRIED), "threads": (threads_left, THREADS_TRIED)}[scarce]
    return [outcome(make, left(count)) for count in range(tried)]


if __name__ == "__main__":
    print(json.dumps(main(*sys.argv[1:])))
