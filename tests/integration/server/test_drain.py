"""How a server stops."""

import os
import signal
from pathlib import Path

import httpx
import pytest

from offboard.common.wire import messages as wire
from tests.executor_tasks import ON_THIS_COMPUTER
from tests.integration.server.peers import Command, Join, Serve, until

pytestmark = pytest.mark.integration


def test_draining_answers_accepted_requests(serve: Serve, join: Join, pipe: Path) -> None:
    """After `drain` new requests are busy; running and waiting ones are answered before `run` returns."""
    running = serve(message_bytes_max=2**26, blob_bytes_max=2**26)
    peer = join(running.server.endpoint)
    peer.request(1, "served_pipe", str(pipe))
    peer.request(2, "served_zeros", 15_000_000)  # still being sent when the last turn is over
    until(lambda: running.server.status().queue_depth == 1)
    running.server.drain()
    peer.request(3, "served_count")
    assert (peer.reply().status, pipe.write_text("go")) == ("busy", 2)
    assert [(reply.id, reply.status) for reply in (peer.reply(), peer.reply())] == [(1, "ok"), (2, "ok")]
    until(lambda: running.answered is True)


def test_draining_is_bounded(serve: Serve, join: Join, pipe: Path) -> None:
    """After the drain time, waiting requests are answered `busy`, and the connection of running ones breaks.

    For a running task `busy` would mean that it never ran, and it might then run twice.
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


@pytest.mark.parametrize("executor", ON_THIS_COMPUTER)
def test_sigterm_lets_the_running_task_finish(folder: Path, join: Join, pipe: Path, executor: str) -> None:
    """After SIGTERM the running task is answered, new ones are busy, and the exit code is 0."""
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


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_for_all_processes_leaves_the_workers_alive(
    folder: Path, join: Join, pipe: Path, number: int
) -> None:
    """Ctrl-C in a terminal and some service managers signal the workers too: tasks are answered first."""
    command = Command(folder, "--executor", "processes", "--workers", "1")
    peer = join(command.endpoint)
    peer.request(1, "served_pipe", str(pipe))
    peer.request(2, "served_count")
    until(lambda: httpx.get(f"{command.http}/health").json()["queue_depth"] == 1)
    for pid in children(command.process.pid):
        os.kill(pid, number)
    command.process.send_signal(number)
    until(lambda: httpx.get(f"{command.http}/ready").status_code == 503)
    pipe.write_text("the answer")
    assert [(reply.id, reply.status) for reply in (peer.reply(), peer.reply())] == [(1, "ok"), (2, "ok")]
    assert command.end(0)[0] == 0


def children(pid: int) -> list[int]:
    """The processes that its threads have started."""
    found = Path(f"/proc/{pid}/task").glob("*/children")
    return [int(child) for one in found for child in one.read_text().split()]


def test_a_hanging_task_does_not_delay_the_exit(folder: Path, join: Join, pipe: Path) -> None:
    """After the drain time the process exits with code 1, although a thread still runs."""
    command = Command(folder, "--drain-s", "0.1")
    join(command.endpoint).request(1, "served_pipe", str(pipe))
    until(lambda: httpx.get(f"{command.http}/health").json()["running"] == 1)
    code, rest = command.end(signal.SIGINT)
    assert code == 1
    assert "still running after the drain time of 0.1 s" in rest
