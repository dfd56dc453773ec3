"""A server in this process or in one of its own, and a peer that speaks raw wire messages to it."""

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import zmq

from offboard.cloud_server.executors import EXECUTORS
from offboard.cloud_server.metrics import Metrics
from offboard.cloud_server.server import Limits, Server
from offboard.common.wire import messages as wire
from offboard.common.wire.messages import Reply, Request
from tests.flags import completed

ROOT = Path(__file__).parents[3]
WAIT_S = 8.0
MODULE = '''
import os, signal, sys, threading, time
from offboard.common.errors import Unwanted
from offboard.common.tasks import task
from offboard.common.task_call import check_wanted

started = []

@task("served_sum", size=lambda array: array.size, duplicate=False)
def served_sum(array):
    return float(array.sum())

@task("served_raise", size=lambda text: 0)
def served_raise(text):
    raise ValueError(text)

@task("served_zeros", size=lambda count: count)
def served_zeros(count):
    return b"0" * count

@task("served_pipe", size=lambda path: 0)
def served_pipe(path):
    """Run until a text is written to the named pipe."""
    started.append(path)
    with open(path) as pipe:
        return pipe.read()

@task("served_count", size=lambda: 0)
def served_count():
    return len(started)

@task("served_thread", size=lambda: 0)
def served_thread():
    return threading.get_ident()

@task("served_look", size=lambda path: 0)
def served_look(path):
    """Run until nobody waits for the answer, or a text is written to the file."""
    started.append(path)
    return look(path)

@task("served_once", size=lambda path: 0, duplicate=False)
def served_once(path):
    return look(path)

def look(path):
    with open(path + ".begun", "a") as begun:
        print("begun", file=begun)
    try:
        while not os.path.getsize(path):
            check_wanted()
            time.sleep(0.002)
    except Unwanted:
        with open(path + ".stopped", "a") as stopped:
            print("stopped", file=stopped)
        raise
    with open(path + ".ended", "a") as ended:
        print("ended", file=ended)

@task("served_fork", size=lambda how: 0)
def served_fork(how):
    child = os.fork()
    if child == 0 and how == "raises":
        raise ValueError(how)
    if child == 0 and how == "exits":
        sys.exit(3)
    return child

@task("served_die", size=lambda: 0)
def served_die():
    os.kill(os.getpid(), signal.SIGKILL)
'''


class Running:
    """A server in a thread of this process. `limits` are fields of `Limits`."""

    def __init__(self, executor: str = "threads", *, workers: int = 1, **limits: Any) -> None:
        limits = {
            "queue_max": 8,
            "blob_bytes_max": 2**20,
            "message_bytes_max": 2**20,
            "robot_bytes_per_s": 2**30,
            "drain_s": 5,
        } | limits
        self.metrics = Metrics()
        ready = threading.Event()
        self.pool = EXECUTORS[executor](workers, ["served_tasks"], limits["blob_bytes_max"])
        self.server = Server(
            "tcp://127.0.0.1:0", self.pool, self.metrics, Limits(**limits), on_ready=ready.set
        )
        self.answered: bool | None = None
        self._thread = threading.Thread(target=self._run)
        self._thread.start()
        assert ready.wait(WAIT_S)

    def _run(self) -> None:
        self.answered = self.server.run()

    def counted(self, name: str, **labels: str) -> float:
        """The value of a metric; 0 if it has no such labels yet."""
        full, registry = f"offboard_server_{name}", self.metrics.registry
        assert any(full.removesuffix("_total") == one.name for one in registry.collect()), full
        return registry.get_sample_value(full, labels) or 0.0

    def close(self) -> None:
        self.server.drain()
        self._thread.join(WAIT_S)
        assert not self._thread.is_alive()


class Peer:
    """A robot that sends and receives raw wire messages."""

    def __init__(self, endpoint: str, *, unread_max: int = 1000) -> None:
        self._context = zmq.Context()
        self.socket = self._context.socket(zmq.DEALER)
        self.socket.setsockopt(zmq.RCVHWM, unread_max)
        self.socket.setsockopt(zmq.LINGER, 0)
        self.socket.connect(endpoint)

    def send(self, message: wire.Message) -> None:
        self.socket.send_multipart(wire.pack(message))

    def receive(self, timeout_s: float = WAIT_S) -> wire.Message:
        assert self.socket.poll(int(timeout_s * 1000)), "no answer"
        return wire.unpack(self.socket.recv_multipart())

    def request(self, id: int, kind: str, *args: Any, budget_s: float = WAIT_S) -> dict[bytes, memoryview]:
        """Send a request; returns the blobs that it refers to."""
        body = wire.encode(args, blobs=True)
        self.send(Request(id, kind, budget_s, 1, tuple(body.blobs), body.frames))
        return body.blobs

    def reply(self) -> Reply:
        message = self.receive()
        assert isinstance(message, Reply), message
        return message

    def value(self, id: int, kind: str, *args: Any) -> Any:
        self.request(id, kind, *args)
        reply = self.reply()
        assert (reply.id, reply.status, reply.error) == (id, "ok", "")
        return wire.decode(reply.body, [], {})

    def close(self) -> None:
        self.socket.close()
        self._context.term()


Serve = Callable[..., Running]
Join = Callable[[str], Peer]


def until(condition: Callable[[], bool]) -> None:
    """Wait until another thread or process has done something."""
    end = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < end, f"it did not happen within {WAIT_S:g} s"
        time.sleep(0.005)


class Command:
    """`python -m offboard.cloud_server` as a child process. It is ready once it is constructed."""

    def __init__(self, folder: Path, *flags: str) -> None:
        self.process = start(folder, *flags)
        self.lines: list[str] = []
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self.lines.append(line)
            if " ready: " in line:
                break
        self.endpoint, self.http = self.lines[-1].split("listening on ")[1].strip().split(", ")

    def end(self, number: int) -> tuple[int, str]:
        self.process.send_signal(number)
        return self.process.wait(WAIT_S), self.process.communicate()[1]


def start(folder: Path, *flags: str) -> "subprocess.Popen[str]":
    free = {"listen": "tcp://127.0.0.1:0", "http": "127.0.0.1:0"}
    command = [sys.executable, "-W", "error", "-m", "offboard.cloud_server"]
    return subprocess.Popen(
        [*command, *completed(flags, tasks="served_tasks", **free)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": f"{folder}:{ROOT}"},
    )
