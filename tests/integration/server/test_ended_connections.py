"""A robot that dies, closes or falls silent gives the workers and the queue of the server to the next one."""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from offboard import Offloader
from offboard.cloud_server import connections
from offboard.common.tasks import kind_named
from offboard.common.wire.messages import Cancel, Ping
from tests.executor_tasks import ON_THIS_COMPUTER
from tests.integration.server.peers import ROOT, WAIT_S, Join, Peer, Running, Serve, until
from tests.relays import Wan

pytestmark = pytest.mark.integration

TIMEOUT_S = 40.0  # of the robots: longer than any wait here
QUEUE = 3
ROBOT = f"""
import sys
import served_tasks
from offboard import Offloader
from served_tasks import served_look
served_tasks.look = lambda path: None  # what runs onboard after the close leaves no trace
with Offloader.connect(sys.argv[1], timeout_s={TIMEOUT_S}) as offload:
    assert offload.wait_for_sites(served_look, {WAIT_S}) == {{}}
    calls = [offload.submit(served_look, sys.argv[2], where="cloud") for _ in range({1 + QUEUE})]
    sys.stdin.readline()
print("closed", flush=True)
sys.stdin.readline()
"""

Robot = Callable[[str], "subprocess.Popen[str]"]


@pytest.fixture
def waits(tmp_path: Path) -> str:
    """The file that `served_look` and `served_once` wait for."""
    path = tmp_path / "go"
    path.touch()
    return str(path)


@pytest.fixture
def robot(folder: Path, waits: str) -> Iterator[Robot]:
    """Starts a process with more calls than the server has places for."""
    with ExitStack() as stack:

        def start(endpoint: str) -> "subprocess.Popen[str]":
            environ = os.environ | {"PYTHONPATH": f"{folder}:{ROOT}"}
            command, pipe = [sys.executable, "-c", ROBOT, endpoint, waits], subprocess.PIPE
            process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, env=environ)
            stack.enter_context(process)
            stack.callback(process.kill)
            return process

        yield start


def full(running: Running) -> bool:
    status = running.server.status()
    return (status.running, status.queue_depth) == (1, QUEUE)


def idle(running: Running) -> bool:
    status = running.server.status()
    return (status.running, status.queue_depth) == (0, 0)


def until_idle(running: Running, waits: str) -> None:
    """The run that had begun is stopped, and those that waited never begin."""
    until(lambda: idle(running))
    assert Path(f"{waits}.begun").read_text() == "begun\n"
    assert Path(f"{waits}.stopped").read_text() == "stopped\n"
    assert running.counted("requests_total", kind="served_look", status="cancelled") == 1 + QUEUE
    with Offloader.connect(running.server.endpoint, policy="cloud", timeout_s=TIMEOUT_S) as offload:
        count = kind_named("served_count").function
        assert offload.wait_for_sites(count, WAIT_S) == {}
        offload(count)
        assert offload.last is not None
        assert offload.last.used == "cloud"


@pytest.mark.parametrize("executor", ON_THIS_COMPUTER)
def test_a_robot_that_is_killed_frees_the_server(
    serve: Serve, robot: Robot, waits: str, executor: str
) -> None:
    """Long before its requests expire, and the task of the next robot runs in the cloud."""
    running = serve(executor, queue_max=QUEUE)
    process = robot(running.server.endpoint)
    until(lambda: full(running))
    process.kill()
    until_idle(running, waits)


@pytest.mark.parametrize("executor", ON_THIS_COMPUTER)
def test_a_robot_that_closes_frees_the_server(
    serve: Serve, robot: Robot, waits: str, executor: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It cancels its requests, so the server need not look for ended connections."""
    monkeypatch.setattr(connections.Connections, "ended", lambda *_: False)
    running = serve(executor, queue_max=QUEUE)
    process = robot(running.server.endpoint)
    until(lambda: full(running))
    print(file=process.stdin, flush=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "closed\n"
    until_idle(running, waits)


def test_a_robot_that_dies_without_a_link_frees_the_server(
    serve: Serve,
    robot: Robot,
    wan: Callable[..., Wan],
    waits: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Nothing ends its connection to the server, but it has sent heartbeats, and sends none any more."""
    monkeypatch.setattr(connections, "SILENT_S", 3.0)
    running = serve(queue_max=QUEUE)
    relay = wan(port(running))
    process = robot(f"tcp://127.0.0.1:{relay.port}")
    until(lambda: full(running))
    relay.change(outage=True)
    process.kill()
    until_idle(running, waits)


def test_a_robot_that_waits_is_not_silent(serve: Serve, waits: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its heartbeats show that it is there, however long the task runs."""
    silent_s = 4.0  # an idle robot on a busy computer sends a heartbeat every 2.4 s
    monkeypatch.setattr(connections, "SILENT_S", silent_s)
    running = serve()
    look = kind_named("served_look").function
    with Offloader.connect(running.server.endpoint, timeout_s=TIMEOUT_S) as offload:
        assert offload.wait_for_sites(look, WAIT_S) == {}
        call = offload.submit(look, waits, where="cloud")
        time.sleep(2 * silent_s)
        Path(waits).write_text("go")
        call.result(WAIT_S)
        assert offload.last is not None
        assert offload.last.used == "cloud"
    assert not Path(f"{waits}.stopped").exists()


def test_a_peer_without_heartbeats_may_be_silent(
    serve: Serve, join: Join, waits: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It gets its answer after any time."""
    monkeypatch.setattr(connections, "SILENT_S", 0.2)
    peer = join(serve().server.endpoint)
    peer.request(1, "served_look", waits)
    time.sleep(3 * connections.LOOK_S)
    Path(waits).write_text("go")
    assert peer.reply().id == 1


def test_a_large_argument_on_a_slow_link_is_no_silence(
    serve: Serve, join: Join, wan: Callable[..., Wan], waits: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Heartbeats wait behind it, but its bytes come in."""
    monkeypatch.setattr(connections, "SILENT_S", 1.0)
    running = serve(workers=2)
    relay = wan(port(running), "--bandwidth-mbps", "1")
    peer = join(f"tcp://127.0.0.1:{relay.port}")
    peer.send(Ping(1))
    peer.receive()
    peer.request(1, "served_look", waits)
    count = 400_000 // 8
    peer.socket.send_multipart([b"nonsense", bytes(8 * count)])  # takes 3.2 s
    peer.request(2, "served_sum", np.ones(3))
    assert peer.reply().id == 2
    Path(waits).write_text("go")
    assert peer.reply().status == "ok"


def test_a_short_outage_loses_no_answer(serve: Serve, wan: Callable[..., Wan], waits: str) -> None:
    """The task ends while there is no link; its answer comes when the link is back."""
    running = serve()
    relay = wan(port(running))
    look = kind_named("served_look").function
    with Offloader.connect(f"tcp://127.0.0.1:{relay.port}", policy="cloud", timeout_s=TIMEOUT_S) as offload:
        assert offload.wait_for_sites(look, WAIT_S) == {}
        call = offload.submit(look, waits)
        until(lambda: Path(f"{waits}.begun").exists())
        relay.change(outage=True)
        time.sleep(4 * connections.LOOK_S)
        Path(waits).write_text("go")
        until(lambda: idle(running))
        relay.change(outage=False)
        call.result(WAIT_S)
        assert offload.last is not None
        assert offload.last.used == "cloud"


def cancel_both(peer: Peer) -> None:
    for number in (2, 1):
        peer.send(Cancel(number))


@pytest.mark.parametrize("leave", [Peer.close, cancel_both], ids=["gone", "cancelled"])
@pytest.mark.parametrize("executor", ON_THIS_COMPUTER)
def test_a_run_that_must_not_be_repeated_goes_on(
    serve: Serve, join: Join, waits: str, executor: str, leave: Callable[[Peer], None]
) -> None:
    """It ends as if its robot still waited, and nobody is answered; a request that waits never begins."""
    running = serve(executor)
    peer = join(running.server.endpoint)
    for number in (1, 2):
        peer.request(number, "served_once", waits, budget_s=TIMEOUT_S)
    until(lambda: Path(f"{waits}.begun").exists())
    until(lambda: running.server.status().queue_depth == 1)
    leave(peer)
    until(lambda: running.server.status().queue_depth == 0)
    time.sleep(0.2)  # a run that was to stop would have
    Path(waits).write_text("go")
    until(lambda: idle(running))
    assert Path(f"{waits}.begun").read_text() == "begun\n"
    assert Path(f"{waits}.ended").read_text() == "ended\n"
    assert not Path(f"{waits}.stopped").exists()
    assert running.counted("requests_total", kind="served_once", status="cancelled") == 2


@pytest.mark.parametrize("executor", ON_THIS_COMPUTER)
def test_a_run_that_must_not_be_repeated_ends_with_its_budget(
    serve: Serve, join: Join, waits: str, executor: str
) -> None:
    """Even if its robot has left, it keeps its worker no longer than the budget that it was given."""
    running = serve(executor)
    peer = join(running.server.endpoint)
    peer.request(1, "served_once", waits, budget_s=2.0)
    until(lambda: Path(f"{waits}.begun").exists())
    peer.close()
    until(lambda: idle(running))
    assert Path(f"{waits}.stopped").read_text() == "stopped\n"


def port(running: Running) -> int:
    return int(running.server.endpoint.rpartition(":")[2])
