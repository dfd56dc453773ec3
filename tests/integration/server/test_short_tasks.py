"""Short tasks run in the thread that reads the socket, and keep nobody waiting if they are long after all."""

from itertools import pairwise
from pathlib import Path

import pytest

from offboard.common.wire.messages import Ping, Pong
from tests.integration.server.peers import Join, Serve

pytestmark = pytest.mark.integration

TASKS = 20


def test_short_tasks_stay_in_one_thread(serve: Serve, join: Join) -> None:
    """Once a kind is known to be short, its tasks run in the thread that reads, without a hand-over."""
    peer = join(serve(workers=2).server.endpoint)
    threads = [peer.value(id, "served_thread") for id in range(1, TASKS)]
    moves = sum(before != after for before, after in pairwise(threads))
    assert moves < TASKS / 2, threads  # a computer that stalls makes a task long, and a hand-over


def test_a_long_task_of_a_short_kind_blocks_nobody(
    serve: Serve, join: Join, tmp_path: Path, pipe: Path
) -> None:
    """If a task of a short kind runs long, another thread reads: heartbeats and tasks are answered."""
    running = serve(workers=2)
    slow, other = (join(running.server.endpoint) for _ in range(2))
    empty = tmp_path / "empty"
    empty.touch()
    for id in range(1, TASKS):
        assert slow.value(id, "served_pipe", str(empty)) == ""
    slow.request(TASKS, "served_pipe", str(pipe))
    other.send(Ping(1))
    assert isinstance(other.receive(), Pong)
    assert other.value(2, "served_count") >= TASKS
    pipe.write_text("done")
    assert slow.reply().id == TASKS
    assert slow.value(TASKS + 1, "served_pipe", str(empty)) == ""


def test_short_tasks_of_one_message_burst_are_all_answered(serve: Serve, join: Join) -> None:
    """Requests that wait while a short task runs are answered too, by whichever thread reads then."""
    peer = join(serve(workers=2, queue_max=100).server.endpoint)
    peer.value(0, "served_count")
    for id in range(1, TASKS):
        peer.request(id, "served_count")
    assert {peer.reply().id for _ in range(1, TASKS)} == set(range(1, TASKS))
