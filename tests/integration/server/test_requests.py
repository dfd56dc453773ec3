"""What becomes of a request: its answer, or the reason why it does not run."""

import importlib
import os
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from offboard import Offloader
from offboard.common import VERSION
from offboard.common.errors import TaskFailed
from offboard.common.load import LOADED
from offboard.common.tasks import kind_named
from offboard.common.wire import messages as wire
from offboard.common.wire.messages import Cancel, Hello, Ping, Pong
from tests.executor_tasks import ON_THIS_COMPUTER
from tests.integration.server.peers import WAIT_S, Join, Serve, until

pytestmark = pytest.mark.integration


@pytest.mark.parametrize("executor", ON_THIS_COMPUTER)
def test_a_request_is_answered(serve: Serve, join: Join, executor: str) -> None:
    """With every executor, the reply holds the result and the server's queue, run and CPU seconds."""
    peer = join(serve(executor).server.endpoint)
    peer.request(7, "served_sum", np.arange(100.0))
    reply = peer.reply()
    assert (reply.id, reply.status, wire.decode(reply.body, [], {})) == (7, "ok", 4950.0)
    assert reply.run_s > 0
    assert reply.cpu_s > 0
    assert reply.queue_s > 0
    assert reply.queue_depth == 0


@pytest.mark.parametrize("executor", ON_THIS_COMPUTER)
def test_failed_and_unknown_tasks_are_answered(serve: Serve, join: Join, executor: str) -> None:
    """A task that raises is answered `failed` with the error; an unknown task is `unknown_task`."""
    running = serve(executor)
    peer = join(running.server.endpoint)
    peer.request(1, "served_raise", "no such place")
    peer_reply = peer.reply()
    assert (peer_reply.id, peer_reply.status) == (1, "failed")
    assert peer_reply.error == "ValueError: no such place"
    assert peer_reply.traceback.splitlines()[-1] == "ValueError: no such place"
    assert peer_reply.cpu_s > 0
    peer.request(2, "never_heard_of")
    reply = peer.reply()
    assert (reply.id, reply.status, reply.cpu_s) == (2, "unknown_task", None)
    assert running.counted("requests_total", kind="unknown", status="unknown_task") == 1


@pytest.mark.parametrize("where", ["cloud", "onboard"])
@pytest.mark.parametrize("executor", ON_THIS_COMPUTER)
def test_a_failed_task_comes_with_its_traceback(serve: Serve, executor: str, where: str) -> None:
    """It begins in the function of the task; the error has the text and the name of the task."""
    running, function = serve(executor), kind_named("served_raise").function
    with Offloader.connect(running.server.endpoint) as offload:
        assert not offload.wait_for_sites(function, WAIT_S)
        with pytest.raises(TaskFailed) as caught:
            offload(function, "no such place", where=where)
    assert str(caught.value) == "task served_raise: ValueError: no such place"
    first, place, *_, last = caught.value.traceback.splitlines()
    assert first == "Traceback (most recent call last):"
    assert "served_tasks.py" in place
    assert "in served_raise" in place
    assert last == "ValueError: no such place"


def test_hello_and_ping_are_answered(serve: Serve, join: Join) -> None:
    """Hello returns tasks and source hashes, ping the queue depth; another wire version gets a hello too."""
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


@pytest.mark.parametrize("executor", ON_THIS_COMPUTER)
def test_a_server_reports_its_load(serve: Serve, join: Join, executor: str) -> None:
    """If other programs compute on all CPUs, pongs, replies and metrics soon show it."""
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
        assert running.counted("other_load_ratio") > 0


def test_a_full_queue_is_busy(serve: Serve, join: Join, pipe: Path) -> None:
    """With one request running and two waiting, the next one is busy; the others are answered in order."""
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


def test_the_memory_of_waiting_requests_is_bounded(serve: Serve, join: Join, pipe: Path) -> None:
    """The answer is `busy` before waiting requests hold more memory than the limits allow."""
    peer = join(serve(queue_max=100).server.endpoint)
    peer.request(0, "served_pipe", str(pipe))
    for id in range(1, 50):
        peer.request(id, "served_sum", *[np.zeros(8000)] * 4)  # 256 kB each, never blobs
    refused = [peer.reply() for _ in range(49 - 8)]
    assert {reply.status for reply in refused} == {"busy"}
    assert [reply.id for reply in refused] == list(range(9, 50))


def test_an_expired_request_never_runs(serve: Serve, join: Join, pipe: Path) -> None:
    """If the budget ends while a request waits, it is answered `expired` and its task does not start."""
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
    """Cancel removes the waiting request of this robot only; a running request is not answered."""
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


def test_a_result_that_is_too_large_is_a_failure(serve: Serve, join: Join) -> None:
    """A result above the message limit is answered `failed` with both sizes."""
    peer = join(serve(message_bytes_max=2**18).server.endpoint)
    peer.request(1, "served_zeros", 2**19)
    reply = peer.reply()
    assert reply.status == "failed"
    assert reply.error.startswith("BadValue: the result takes 524293 bytes, at most 262144")
