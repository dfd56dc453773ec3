"""What happens to tasks when their worker or its node is lost, and when nodes join."""

import os
import signal
from collections.abc import Callable
from pathlib import Path
from queue import SimpleQueue

import pytest

from offboard.cloud_server.executors import Executor
from offboard.cloud_server.executors.worker import OVERTIME_S
from tests.executor_tasks import call, run, value
from tests.ray.clusters import RayNodes
from tests.ray.servers import until

pytestmark = [pytest.mark.integration, pytest.mark.timeout(180)]

WAIT_S = 60.0


@pytest.fixture
def changes() -> SimpleQueue[str]:
    return SimpleQueue()


def test_a_killed_worker_is_a_fault_of_the_server(
    nodes: RayNodes, connect: Callable[..., Executor], changes: SimpleQueue[str], tmp_path: Path
) -> None:
    """The task fails at once, so that it runs onboard; another worker takes the place of the dead one."""
    executor = connect(nodes, workers=1, changed=changes.put)
    pid = value(run(executor, "exec_where", 0))[0]
    begun, never = tmp_path / "begun", tmp_path / "never"
    os.mkfifo(begun)
    os.mkfifo(never)
    failing = executor.submit(call("exec_look", str(begun)), lambda _: None)
    assert begun.read_text() == "begun"
    used_s = executor.used_s()
    os.kill(pid, signal.SIGKILL)
    outcome = failing.result(WAIT_S)
    assert (outcome.status, outcome.server_fault, outcome.crashed) == ("failed", True, True)
    assert outcome.error == "the worker died, or its node does not answer while this task ran"
    until(lambda: executor.up == 1)
    assert value(run(executor, "exec_where", 0))[0] != pid
    assert executor.used_s() >= used_s
    assert "exit" in [changes.get_nowait() for _ in range(changes.qsize())]


def test_a_task_is_killed_after_its_budget(
    nodes: RayNodes, connect: Callable[..., Executor], tmp_path: Path
) -> None:
    """It is asked to stop when the budget is over, and killed a second later."""
    executor = connect(nodes, workers=1)
    pipe = tmp_path / "never"
    os.mkfifo(pipe)
    hanging = call("exec_wait_for_file", str(pipe), budget_s=0.2)
    outcome = executor.submit(hanging, lambda _: None).result(WAIT_S)
    assert (outcome.status, outcome.server_fault, outcome.crashed) == ("failed", True, True)
    assert outcome.error.startswith(f"the worker was killed {OVERTIME_S:g} s after the budget was over")
    until(lambda: executor.up == 1)
    assert value(run(executor, "exec_echo", 5)) == 5


def test_nodes_leave_and_join(nodes: RayNodes, connect: Callable[..., Executor], tmp_path: Path) -> None:
    """The worker of a lost node waits for another node, and the other worker goes on."""
    executor = connect(nodes, workers=2)
    begun = tmp_path / "begun"
    os.mkfifo(begun)
    nodes.kill(nodes.nodes.pop())
    until(lambda: executor.up == 1)
    for number in range(20):
        assert value(run(executor, "exec_echo", number)) == number
    nodes.nodes.append(nodes.add())
    until(lambda: executor.up == 2)
    assert sum(executor.places().values()) == 2


def test_closing_ends_the_actors(nodes: RayNodes, connect: Callable[..., Executor], tmp_path: Path) -> None:
    """A hanging task is abandoned with an answer, and no process of an actor is left."""
    executor = connect(nodes, workers=1)
    pid = value(run(executor, "exec_where", 0))[0]
    pipe = tmp_path / "never"
    os.mkfifo(pipe)
    hanging = executor.submit(call("exec_wait_for_file", str(pipe)), lambda _: None)
    executor.close()
    executor.close()
    assert hanging.result(WAIT_S).error == "the worker was ended with the server while this task ran"
    until(lambda: not Path(f"/proc/{pid}").exists())
