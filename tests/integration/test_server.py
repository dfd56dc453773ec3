"""The server over real sockets, spoken to in raw wire messages."""

import importlib
import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import zmq

from offboard.cloud_server.executors import EXECUTORS, SPARES
from offboard.cloud_server.http_api import Web, create_app
from offboard.cloud_server.metrics import Metrics
from offboard.cloud_server.server import Server
from offboard.common import VERSION
from offboard.common.errors import ConfigError
from offboard.common.host.load import LOADED
from offboard.common.wire import messages as wire
from offboard.common.wire.messages import Blob, Cancel, Hello, Ping, Pong, Reply, Request

pytestmark = pytest.mark.integration

ROOT = Path(__file__).parents[2]
WAIT_S = 8.0
MODULE = '''
import os, signal
from offboard.common.tasks import task

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
    """Runs until somebody writes to the named pipe."""
    started.append(path)
    with open(path) as pipe:
        return pipe.read()

@task("served_count", size=lambda: 0)
def served_count():
    return len(started)

@task("served_die", size=lambda: 0)
def served_die():
    os.kill(os.getpid(), signal.SIGKILL)
'''


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder = tmp_path_factory.mktemp("tasks")
    (folder / "served_tasks.py").write_text(MODULE)
    patch = pytest.MonkeyPatch()
    patch.syspath_prepend(folder)
    importlib.import_module("served_tasks")
    yield folder
    patch.undo()


class Running:
    """A server in a thread of this process."""

    def __init__(self, executor: str = "threads", *, workers: int = 1, **bounds: Any) -> None:
        bounds = {
            "queue_max": 8,
            "blob_bytes_max": 2**20,
            "message_bytes_max": 2**20,
            "robot_bytes_a_s": 2**30,
            "drain_s": 5,
        } | bounds
        self.metrics = Metrics()
        ready = threading.Event()
        pool = EXECUTORS[executor](workers, ["served_tasks"], bounds["blob_bytes_max"])
        self.pool = pool
        self.server = Server("tcp://127.0.0.1:0", pool, self.metrics, on_ready=ready.set, **bounds)
        self.answered: bool | None = None
        self._thread = threading.Thread(target=self._run)
        self._thread.start()
        assert ready.wait(WAIT_S)

    def _run(self) -> None:
        self.answered = self.server.run()

    def counted(self, name: str, **labels: str) -> float:
        return self.metrics.registry.get_sample_value(f"offboard_{name}", labels) or 0.0

    def close(self) -> None:
        self.server.drain()
        self._thread.join(WAIT_S)
        assert not self._thread.is_alive()


@pytest.fixture
def serve(folder: Path) -> Iterator[Callable[..., Running]]:
    with ExitStack() as stack:

        def start(*args: Any, **bounds: Any) -> Running:
            running = Running(*args, **bounds)
            stack.callback(running.close)
            return running

        assert folder
        yield start


class Peer:
    """A raw DEALER that speaks wire messages."""

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
        """Send a request; the blobs that it refers to."""
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


@pytest.fixture
def join() -> Iterator[Callable[[str], Peer]]:
    with ExitStack() as stack:

        def connect(endpoint: str) -> Peer:
            peer = Peer(endpoint)
            stack.callback(peer.close)
            return peer

        yield connect


Serve = Callable[..., Running]
Join = Callable[[str], Peer]


@pytest.fixture
def pipe(tmp_path: Path) -> Iterator[Path]:
    """A named pipe for `served_pipe`; whoever still waits at the end is let go."""
    path = tmp_path / "pipe"
    os.mkfifo(path)
    yield path
    while True:
        try:
            os.close(os.open(path, os.O_WRONLY | os.O_NONBLOCK))
        except OSError:
            return
        time.sleep(0.01)


def until(condition: Callable[[], bool]) -> None:
    """Wait for something that another thread does."""
    end = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.005)


@pytest.mark.parametrize("executor", sorted(EXECUTORS))
def test_a_request_is_answered(serve: Serve, join: Join, executor: str) -> None:
    """The result comes with the server's own queue, run and CPU seconds, whichever executor runs it."""
    peer = join(serve(executor).server.endpoint)
    peer.request(7, "served_sum", np.arange(100.0))
    reply = peer.reply()
    assert (reply.id, reply.status, wire.decode(reply.body, [], {})) == (7, "ok", 4950.0)
    assert reply.run_s > 0
    assert reply.cpu_s > 0
    assert reply.queue_s > 0
    assert reply.queue_depth == 0


@pytest.mark.parametrize("executor", sorted(EXECUTORS))
def test_faults_of_the_task_are_told(serve: Serve, join: Join, executor: str) -> None:
    """A task that raises is failed with its text, an unknown one unknown_task."""
    running = serve(executor)
    peer = join(running.server.endpoint)
    peer.request(1, "served_raise", "no such place")
    peer_reply = peer.reply()
    assert (peer_reply.id, peer_reply.status) == (1, "failed")
    assert peer_reply.error == "ValueError: no such place"
    assert peer_reply.cpu_s > 0
    peer.request(2, "never_heard_of")
    reply = peer.reply()
    assert (reply.id, reply.status, reply.cpu_s) == (2, "unknown_task", None)
    assert running.counted("requests_total", kind="unknown", status="unknown_task") == 1


def test_hello_and_ping_are_answered(serve: Serve, join: Join) -> None:
    """Hello gives tasks with their source hashes, ping the queue depth; another version gets hello too."""
    peer = join(serve().server.endpoint)
    peer.send(Hello({}, "test", 1024))
    hello = peer.receive()
    assert isinstance(hello, Hello)
    assert len(hello.tasks["served_sum"]) == 64
    assert hello.software == VERSION
    peer.send(Ping(5))
    pong = peer.receive()
    assert isinstance(pong, Pong)
    assert (pong.id, pong.queue_depth) == (5, 0)
    peer.socket.send_multipart([bytes.fromhex("9202a568656c6c6f")])
    assert peer.receive() == hello


@pytest.mark.parametrize("executor", sorted(EXECUTORS))
def test_a_server_says_that_others_take_its_cpu(serve: Serve, join: Join, executor: str) -> None:
    """In pongs, replies and metrics, soon after other programs began to compute on all of its CPUs."""
    running = serve(executor)
    peer = join(running.server.endpoint)
    with ExitStack() as stack:
        for _ in range(os.cpu_count() or 1):
            busy = stack.enter_context(subprocess.Popen([sys.executable, "-c", "while True: pass"]))
            stack.callback(busy.kill)
        load, until = 0.0, time.monotonic() + WAIT_S
        while load < LOADED:
            assert time.monotonic() < until
            time.sleep(0.05)
            peer.send(Ping(1))
            pong = peer.receive()
            assert isinstance(pong, Pong)
            load = pong.load
        peer.request(2, "served_zeros", 3)
        assert peer.reply().load > 0
        assert running.counted("load") > 0


@pytest.mark.parametrize("executor", sorted(EXECUTORS))
def test_a_blob_is_asked_for_once(serve: Serve, join: Join, executor: str) -> None:
    """The server asks for what it lacks, then answers, and remembers it for the next robot."""
    running = serve(executor)
    peer, other = join(running.server.endpoint), join(running.server.endpoint)
    array = np.arange(50_000.0)
    blobs = peer.request(1, "served_sum", array)
    reply = peer.reply()
    assert (reply.status, reply.missing) == ("need_blob", tuple(blobs))
    peer.send(Blob(next(iter(blobs.values()))))
    assert peer.value(2, "served_sum", array) == array.sum()
    assert other.value(1, "served_sum", array) == array.sum()
    assert running.counted("blob_bytes") == array.nbytes


def test_blobs_stay_within_their_bytes(serve: Serve, join: Join) -> None:
    """Beyond the bound the least recently used blob goes, and is asked for again."""
    running = serve(blob_bytes_max=1_000_000)
    peer = join(running.server.endpoint)
    arrays = [np.full(50_000, n, float) for n in range(4)]
    for n, array in enumerate(arrays):
        for data in peer.request(n, "served_sum", array).values():
            assert peer.reply().status == "need_blob"
            peer.send(Blob(data))
        assert peer.value(10 + n, "served_sum", array) == array.sum()
    assert running.counted("blob_bytes") == 2 * arrays[0].nbytes
    assert peer.value(20, "served_sum", arrays[3]) == arrays[3].sum()
    peer.request(21, "served_sum", arrays[0])
    assert peer.reply().status == "need_blob"


def test_a_waiting_request_keeps_its_blobs(serve: Serve, join: Join, pipe: Path) -> None:
    """What is pushed out of the store while a request waits is still there when it runs."""
    peer = join(serve(blob_bytes_max=500_000).server.endpoint)
    arrays = [np.full(50_000, n, float) for n in range(2)]
    peer.send(Blob(arrays[0].tobytes()))
    peer.request(1, "served_pipe", str(pipe))
    peer.request(2, "served_sum", arrays[0])
    peer.send(Blob(arrays[1].tobytes()))
    peer.request(3, "served_sum", arrays[0])
    assert (peer.reply().status, pipe.write_text("go")) == ("need_blob", 2)
    replies = {reply.id: reply for reply in (peer.reply(), peer.reply())}
    assert replies[1].status == replies[2].status == "ok"


def test_a_full_queue_is_busy(serve: Serve, join: Join, pipe: Path) -> None:
    """One runs, two wait, the next is busy at once; those accepted are all answered, in order."""
    running = serve(queue_max=2)
    peer = join(running.server.endpoint)
    for id in (1, 2, 3, 4):
        peer.request(id, "served_pipe" if id == 1 else "served_count", *([str(pipe)] if id == 1 else []))
    reply = peer.reply()
    assert (reply.id, reply.status, reply.queue_depth) == (4, "busy", 2)
    pipe.write_text("go")
    replies = [peer.reply() for _ in range(3)]
    assert [(reply.id, reply.status) for reply in replies] == [(1, "ok"), (2, "ok"), (3, "ok")]
    assert replies[2].queue_s >= replies[1].queue_s > 0


def test_what_waiting_requests_hold_is_bounded(serve: Serve, join: Join, pipe: Path) -> None:
    """A queue of large bodies is busy before it takes more memory than blobs and one message may."""
    peer = join(serve(queue_max=100).server.endpoint)
    peer.request(0, "served_pipe", str(pipe))
    for id in range(1, 50):
        peer.request(id, "served_sum", *[np.zeros(8000)] * 4)  # 256 kB each, never blobs
    refused = [peer.reply() for _ in range(49 - 8)]
    assert {reply.status for reply in refused} == {"busy"}
    assert [reply.id for reply in refused] == list(range(9, 50))


def test_an_expired_request_never_runs(serve: Serve, join: Join, pipe: Path) -> None:
    """A request whose budget is over while it waits is answered expired, and its task is not started."""
    served = importlib.import_module("served_tasks")
    peer = join(serve().server.endpoint)
    before = len(served.started)
    peer.request(1, "served_pipe", str(pipe))
    peer.request(2, "served_pipe", str(pipe), budget_s=0.05)
    reply = peer.reply()
    assert (reply.id, reply.status) == (2, "expired")
    assert reply.queue_s >= 0.05
    pipe.write_text("go")
    assert peer.reply().id == 1
    assert peer.value(3, "served_count") == before + 1


def test_a_cancelled_request_never_runs(serve: Serve, join: Join, pipe: Path) -> None:
    """Cancel takes out this robot's waiting request alone; the answer of a running one is not sent."""
    served = importlib.import_module("served_tasks")
    running = serve()
    peer, other = join(running.server.endpoint), join(running.server.endpoint)
    before = len(served.started)
    peer.request(1, "served_pipe", str(pipe))
    until(lambda: len(served.started) == before + 1)
    peer.request(2, "served_pipe", str(pipe))
    other.request(2, "served_count")
    until(lambda: running.server.status().queue_depth == 2)
    for id in (2, 1, 99):
        peer.send(Cancel(id))
    until(lambda: running.server.status().queue_depth == 1)
    peer.send(Ping(1))
    pong = peer.receive()
    assert isinstance(pong, Pong)
    assert (pong.id, pong.queue_depth) == (1, 1)
    pipe.write_text("go")
    assert other.reply().id == 2
    assert peer.value(3, "served_count") == before + 1


def test_a_result_too_large_is_a_clear_failure(serve: Serve, join: Join) -> None:
    """A result over the message bound is failed and says so."""
    peer = join(serve(message_bytes_max=2**18).server.endpoint)
    peer.request(1, "served_zeros", 2**19)
    reply = peer.reply()
    assert reply.status == "failed"
    assert reply.error.startswith("BadValue: the result takes 524293 bytes, at most 262144")


def test_without_a_worker_the_server_is_busy(serve: Serve, join: Join) -> None:
    """The task that killed the last worker fails; the answer is busy until the next one is warm."""
    running = serve("processes")
    peer = join(running.server.endpoint)
    for _ in range(SPARES):
        peer.request(0, "served_die")
        peer.reply()
        assert running.server.status().ready
    peer.request(1, "served_die")
    reply = peer.reply()
    assert (reply.status, reply.server_fault, reply.run_s > 0) == ("failed", True, True)
    assert reply.error == "the worker was killed by signal SIGKILL while this task ran"
    until(lambda: not running.server.status().ready)
    peer.request(2, "served_count")
    assert peer.reply().status == "busy"
    until(lambda: running.server.status().ready)
    assert peer.value(3, "served_sum", np.ones(9)) == 9
    assert running.counted("executor_restarts_total", reason="signal") == 1 + SPARES


def test_a_dead_worker_leaves_the_others_at_work(serve: Serve, join: Join, pipe: Path) -> None:
    """While one of two is replaced the server stays ready, and takes tasks."""
    running = serve("processes", workers=2)
    peer = join(running.server.endpoint)
    peer.request(1, "served_pipe", str(pipe))
    peer.request(2, "served_die")
    assert (peer.reply().id, running.server.status().ready) == (2, True)
    peer.request(3, "served_zeros", 3)
    assert (peer.reply().id, running.server.status().ready) == (3, True)
    pipe.write_text("go")
    reply = peer.reply()
    assert (reply.id, reply.status) == (1, "ok")


def test_a_request_that_killed_three_workers_is_not_run_again(serve: Serve, join: Join) -> None:
    """The same id of the same robot is refused from then on; other ids and other robots are not."""
    running = serve("processes")
    peer, other = join(running.server.endpoint), join(running.server.endpoint)
    for crashes in range(1, 4):
        peer.request(7, "served_die")
        assert "SIGKILL" in peer.reply().error
        until(lambda: running.counted("executor_restarts_total", reason="signal") == crashes)  # noqa: B023
        until(lambda: running.server.status().ready)
    peer.request(7, "served_die")
    reply = peer.reply()
    assert (reply.status, reply.error) == ("failed", "its worker died 3 times; it is not run again")
    assert peer.value(8, "served_count") == other.value(7, "served_count") == 0
    assert running.counted("executor_restarts_total", reason="signal") == 3


def test_a_run_beyond_its_budget_is_failed_not_expired(serve: Serve, join: Join, pipe: Path) -> None:
    """Expired says that it never began; one whose worker was killed for it did, and must not run twice."""
    peer = join(serve("processes").server.endpoint)
    peer.request(1, "served_pipe", str(pipe), budget_s=0.2)
    reply = peer.reply()
    assert (reply.status, reply.server_fault) == ("failed", True)
    assert reply.error == "the worker was killed 1 s after the budget was over while this task ran"


def test_random_and_mutated_frames_do_no_harm(serve: Serve, join: Join) -> None:
    """2,000 garbage messages beside a good robot: all its requests are answered, memory stays."""
    running = serve(workers=2)
    good, bad = join(running.server.endpoint), join(running.server.endpoint)
    chance = random.Random(11)
    body = wire.encode([np.arange(50.0)])
    valid: list[wire.Message] = [
        Request(1, "served_sum", 5.0, 1, (), body.frames),
        Request(2, "served_sum", 5.0, 1, (bytes(32),), body.frames),
        Reply(3, "ok", body=body.frames),
        Blob(bytes(1000)),
        Hello({"a": "b"}, "1", 1024),
        Ping(4),
        Pong(4),
        Cancel(1),
    ]
    memory = resident_bytes()
    for n in range(2000):
        frames = [bytearray(frame) for frame in wire.pack(chance.choice(valid))]
        mutate(chance, frames)
        bad.socket.send_multipart(frames)
        while bad.socket.poll(0):
            bad.socket.recv_multipart()
        if n % 10 == 0:
            assert good.value(n, "served_sum", np.ones(5)) == 5
    until(lambda: running.server.status().running + running.server.status().queue_depth == 0)
    grown = resident_bytes() - memory
    assert grown < 50 * 2**20
    assert running.counted("dropped_total", reason="malformed") > 500
    assert running.counted("blob_bytes") <= 2**20


def mutate(chance: random.Random, frames: list[bytearray]) -> None:
    at = chance.randrange(len(frames))
    match chance.randrange(6):
        case 0:
            frames[at] = bytearray(chance.randbytes(chance.randrange(300)))
        case 1:
            for _ in range(chance.randrange(1, 4)):
                if frames[at]:
                    frames[at][chance.randrange(len(frames[at]))] = chance.randrange(256)
        case 2:
            del frames[at][chance.randrange(len(frames[at]) + 1) :]
        case 3:
            frames += [bytearray(chance.randbytes(50))] * chance.randrange(1, 20)
        case 4:
            chance.shuffle(frames)
        case _:
            frames[:] = [bytearray(chance.randbytes(chance.randrange(2000)))]


def resident_bytes() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def test_a_message_over_the_bound_is_dropped(serve: Serve, join: Join) -> None:
    """Many frames that together exceed the bound are dropped; a single one ends that connection only."""
    running = serve(message_bytes_max=2**17)
    good, bad = join(running.server.endpoint), join(running.server.endpoint)
    bad.request(1, "served_sum", *[np.zeros(8000)] * 4)
    until(lambda: running.counted("dropped_total", reason="malformed") == 1)
    bad.send(Blob(bytes(2**18)))
    assert good.value(1, "served_sum", np.ones(5)) == 5
    assert running.counted("blob_bytes") == 0


def test_a_robot_that_is_gone_is_no_trouble(serve: Serve, join: Join, pipe: Path) -> None:
    """The reply to a robot that left is dropped and counted; others are served."""
    running = serve()
    leaver = Peer(running.server.endpoint)
    leaver.request(1, "served_pipe", str(pipe))
    until(lambda: running.server.status().running == 1)
    leaver.close()
    peer = join(running.server.endpoint)
    peer.request(1, "served_count")
    until(lambda: running.server.status().queue_depth == 1)
    pipe.write_text("go")
    assert peer.reply().status == "ok"
    assert running.counted("dropped_total", reason="gone") == 1


def test_a_robot_that_does_not_read_cannot_stop_the_others(serve: Serve, join: Join) -> None:
    """Replies nobody reads are dropped beyond a bound and counted; the loop never waits for them."""
    running = serve(workers=2, queue_max=50)
    deaf, good = Peer(running.server.endpoint, unread_max=1), join(running.server.endpoint)
    for n in range(600):
        deaf.request(n, "served_zeros", 100_000)
        assert n % 10 or good.value(n, "served_sum", np.ones(5)) == 5
    assert running.counted("dropped_total", reason="not reading") > 0
    deaf.close()


def test_draining_answers_what_was_accepted(serve: Serve, join: Join, pipe: Path) -> None:
    """After drain a new request is busy; the running and the waiting one are answered before run returns."""
    running = serve(message_bytes_max=2**26, blob_bytes_max=2**26)
    peer = join(running.server.endpoint)
    peer.request(1, "served_pipe", str(pipe))
    peer.request(2, "served_zeros", 15_000_000)  # still leaving when the loop has ended
    until(lambda: running.server.status().queue_depth == 1)
    running.server.drain()
    peer.request(3, "served_count")
    assert (peer.reply().status, pipe.write_text("go")) == ("busy", 2)
    assert [(reply.id, reply.status) for reply in (peer.reply(), peer.reply())] == [(1, "ok"), (2, "ok")]
    until(lambda: running.answered is True)


def test_draining_is_bounded(serve: Serve, join: Join, pipe: Path) -> None:
    """A task that outlives the drain time is given up: who waits is told, who runs hears a break.

    `busy` would say that it never ran, and a task that must not run twice would run again.
    """
    running = serve(drain_s=0.1)
    peer = join(running.server.endpoint)
    peer.request(1, "served_pipe", str(pipe))
    peer.request(2, "served_count")
    until(lambda: running.server.status().queue_depth == 1)
    running.server.drain()
    reply = peer.reply()
    assert (reply.id, reply.status, reply.error) == (2, "busy", "the server stopped")
    until(lambda: running.answered is False)


def test_the_web_shows_the_server(serve: Serve, join: Join) -> None:
    """Health, readiness, metrics, settings, tasks and docs over HTTP, and the thread ends."""
    running = serve()
    web = Web(create_app(running.server.status, running.metrics.registry, {"workers": 1}), ("127.0.0.1", 0))
    web.start()
    assert join(running.server.endpoint).value(1, "served_sum", np.ones(5)) == 5
    with httpx.Client(base_url=f"http://{web.address}", timeout=WAIT_S) as http:
        health = http.get("/health")
        assert health.status_code == 200
        shown = health.json()
        assert shown["healthy"] is True
        assert shown["queue_depth"] == 0
        assert 0 <= shown["last_task_age_s"] <= shown["uptime_s"]
        assert shown["version"] == VERSION
        assert http.get("/ready").status_code == 200
        metrics = http.get("/metrics").text
        assert 'offboard_requests_total{kind="served_sum",status="ok"} 1.0' in metrics
        assert 'offboard_run_seconds_count{kind="served_sum"} 1.0' in metrics
        assert http.get("/config").json() == {"workers": 1}
        task = next(task for task in http.get("/tasks").json() if task["name"] == "served_sum")
        assert task["duplicate"] is False
        assert len(task["source_hash"]) == 64
        assert http.get("/docs").status_code == 200
        running.close()
        running.server._last_turn = time.monotonic() - 60
        assert http.get("/health").status_code == 503
        assert http.get("/ready").status_code == 503
    web.close()
    assert not any(thread.name == "web" for thread in threading.enumerate())


def test_a_port_in_use_is_a_config_error(serve: Serve) -> None:
    """Both sockets name the flag and the address."""
    running = serve()
    bounds: dict[str, Any] = {"queue_max": 1, "blob_bytes_max": 1, "message_bytes_max": 1}
    bounds |= {"robot_bytes_a_s": 1, "drain_s": 1.0}
    with pytest.raises(ConfigError, match=r"--listen: 'tcp://127.0.0.1:\d+' cannot be bound: Address"):
        Server(running.server.endpoint, running.pool, Metrics(), **bounds)
    first = Web(create_app(running.server.status, running.metrics.registry, {}), ("127.0.0.1", 0))
    port = int(first.address.rpartition(":")[2])
    with pytest.raises(ConfigError, match=f"--http: 127.0.0.1:{port} cannot be bound: Address"):
        Web(create_app(running.server.status, running.metrics.registry, {}), ("127.0.0.1", port))
    first.close()


class Command:
    """`python -m cloud_server` as a child process, ready when made."""

    def __init__(self, folder: Path, *flags: str) -> None:
        self.process = start(folder, "--listen", "tcp://127.0.0.1:0", "--http", "127.0.0.1:0", *flags)
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
    return subprocess.Popen(
        [sys.executable, "-W", "error", "-m", "offboard.cloud_server", "--tasks", "served_tasks", *flags],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": f"{folder}:{ROOT}"},
    )


@pytest.mark.parametrize("executor", sorted(EXECUTORS))
def test_sigterm_lets_the_running_task_finish(folder: Path, join: Join, pipe: Path, executor: str) -> None:
    """SIGTERM: the running task is answered, new ones are busy, exit code 0."""
    command = Command(folder, "--executor", executor, "--workers", "1")
    assert sum("settings:" in line for line in command.lines) == 1
    assert httpx.get(f"{command.http}/ready").status_code == 200
    peer = join(command.endpoint)
    peer.request(1, "served_pipe", str(pipe))
    until(lambda: httpx.get(f"{command.http}/health").json()["running"] == 1)
    command.process.send_signal(signal.SIGTERM)
    until(lambda: httpx.get(f"{command.http}/ready").status_code == 503)
    peer.request(2, "served_count")
    reply = peer.reply()
    assert (reply.id, reply.status) == (2, "busy")
    pipe.write_text("the answer")
    assert wire.decode(peer.reply().body, [], {}) == "the answer"
    code, rest = command.end(0)
    assert (code, "every accepted request was answered" in rest) == (0, True)
    assert "Traceback" not in rest


def test_a_task_that_hangs_does_not_hold_the_exit(folder: Path, join: Join, pipe: Path) -> None:
    """Beyond the drain time the process ends with 1, although a thread still runs."""
    command = Command(folder, "--drain-s", "0.1")
    join(command.endpoint).request(1, "served_pipe", str(pipe))
    until(lambda: httpx.get(f"{command.http}/health").json()["running"] == 1)
    code, rest = command.end(signal.SIGINT)
    assert code == 1
    assert "still running after the drain time of 0.1 s" in rest


@pytest.mark.parametrize(
    ("flags", "error"),
    [
        (["--listen", "{zmq}"], "--listen: '{zmq}' cannot be bound: Address already in use"),
        (["--http", "127.0.0.1:{http}"], "--http: 127.0.0.1:{http} cannot be bound: Address already in use"),
        (["--listen", "udp://x:1"], "--listen: 'udp://x:1' is not tcp://HOST:PORT or tcp://*:PORT with"),
        (["--listen", "tcp://x:65536"], "--listen: 'tcp://x:65536' is not tcp://HOST:PORT"),
        (["--http", "8000"], "--http: '8000' is not HOST:PORT with a port 0 to 65535"),
        (["--workers", "0"], "--workers: 0 is below 1, the minimum"),
        (["--executor", "ray"], "--executor: 'ray' is not one of threads, processes"),
        (["--blob-mib", "1"], "--blob-mib: 1 is below --message-mib 64; a large argument would never fit"),
        (
            ["--executor", "processes", "--worker-memory", "256"],
            "--worker-memory: 256 is below --blob-mib 256 and twice --message-mib 64, which a worker needs",
        ),
        (["--tasks", "no_such_module"], "task module 'no_such_module' cannot be imported"),
    ],
)  # fmt: skip
def test_a_users_mistake_is_one_line_and_2(serve: Serve, folder: Path, flags: list[str], error: str) -> None:
    """Exit code 2 and one line that names flag, value and what is allowed; never a traceback."""
    running = serve()
    web = Web(create_app(running.server.status, running.metrics.registry, {}), ("127.0.0.1", 0))
    ports = {
        "zmq": running.server.endpoint,
        "http": web.address.rpartition(":")[2],
    }
    free = ["--listen", "tcp://127.0.0.1:0", "--http", "127.0.0.1:0", "--log", "error"]
    process = start(folder, *free, *(flag.format(**ports) for flag in flags))
    _, text = process.communicate(timeout=WAIT_S)
    web.close()
    assert process.returncode == 2, text
    assert text.startswith(f"cloud-server: {error.format(**ports)}")
    assert text.count("\n") == 1


def test_help_loads_nothing_heavy() -> None:
    """--help answers without zmq, numba and fastapi."""
    code = (
        "import sys; from offboard.cloud_server.__main__ import serve\n"
        "try: serve(['--help'], {})\n"
        "except SystemExit: print({'zmq', 'numba', 'fastapi', 'numpy'} & set(sys.modules))"
    )
    shown = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, timeout=WAIT_S, check=True
    ).stdout
    assert "--listen ENDPOINT" in shown
    assert shown.endswith("set()\n")
