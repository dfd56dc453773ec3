"""What robots see when a worker process dies."""

from pathlib import Path

import numpy as np
import pytest

from offboard.cloud_server.executors.worker_pool import SPARES
from tests.integration.server.peers import Join, Serve, until

pytestmark = pytest.mark.integration


def test_without_a_worker_the_server_is_busy(serve: Serve, join: Join) -> None:
    """After a task has killed the last worker, requests are busy until the next worker is warm."""
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
    assert running.counted("worker_restarts_total", reason="signal") == 1 + SPARES


def test_other_workers_go_on_after_a_death(serve: Serve, join: Join, pipe: Path) -> None:
    """While one of two workers is replaced, the server stays ready and runs tasks."""
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
    """From then on this id of this robot is refused; other ids and other robots are not."""
    running = serve("processes")
    peer, other = join(running.server.endpoint), join(running.server.endpoint)
    for crashes in range(1, 4):
        peer.request(7, "served_die")
        assert "SIGKILL" in peer.reply().error
        until(lambda: running.counted("worker_restarts_total", reason="signal") == crashes)  # noqa: B023
        until(lambda: running.server.status().ready)
    peer.request(7, "served_die")
    reply = peer.reply()
    assert (reply.status, reply.error) == ("failed", "its worker died 3 times; it is not run again")
    assert peer.value(8, "served_count") == other.value(7, "served_count") == 0
    assert running.counted("worker_restarts_total", reason="signal") == 3


def test_a_run_beyond_its_budget_is_failed_not_expired(serve: Serve, join: Join, pipe: Path) -> None:
    """`expired` would mean that the task never started, and it might then run twice."""
    peer = join(serve("processes").server.endpoint)
    peer.request(1, "served_pipe", str(pipe), budget_s=0.2)
    reply = peer.reply()
    assert (reply.status, reply.server_fault) == ("failed", True)
    assert reply.error == "the worker was killed 1 s after the budget was over while this task ran"
