"""The runner of a policy server: one observation at a time, limits, cancelled tasks, and how it ends."""

import json
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import closing, contextmanager
from pathlib import Path
from queue import Queue

import pytest
from websockets.sync.server import ServerConnection

from offboard.common.errors import CloudBroken, CloudBusy, CloudTimeout, Overtaken
from offboard.common.tasks import Task, kind_of, task
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.policy_servers.openpi import pack, unpack
from offboard.robot_client.policy_servers.policy_server import PolicyServerRunner
from offboard.robot_client.sites import conversation
from offboard.robot_client.sites.conversation import IN_TURN_MAX
from offboard.robot_client.sites.runner import Execution
from tests.integration.openpi.bad_servers import says, serving, stays
from tests.integration.openpi.robot import START_S, act, until
from tests.leftovers import left

pytestmark = pytest.mark.integration

ROOT = Path(__file__).parents[3]
KIND = kind_of(act)
SHORT_S = 0.1


@task(
    "openpi_graded",
    policy_server=True,
    size=len,
    variants={"cloud": None},
    quality={"onboard": 0.7, "cloud": 1.0},
)
def graded(observation: dict[str, int]) -> dict[str, int]:
    return {"number": -observation["state"]}


class Held:
    """A server that answers each observation with its number, when the test says so."""

    def __init__(self) -> None:
        self.heard: Queue[int] = Queue()
        self.may_answer = threading.Semaphore(0)
        self.connections = 0

    def talk(self, connection: ServerConnection) -> None:
        self.connections += 1
        for message in connection:
            assert isinstance(message, bytes)
            number = unpack(message)["state"]
            self.heard.put(number)
            self.may_answer.acquire(timeout=START_S)
            connection.send(pack({"number": number}))


@contextmanager
def held() -> Iterator[tuple[PolicyServerRunner, Held]]:
    server = Held()
    with serving(server.talk) as endpoint, closing(PolicyServerRunner(endpoint, site="gpu")) as runner:
        until(lambda: runner.unavailable(KIND) is None)
        yield runner, server
        server.may_answer.release(100)


def submitted(runner: PolicyServerRunner, number: int, budget_s: float = START_S) -> "Future[Execution]":
    return runner.submit(task_of(number), budget_s)


def task_of(number: int) -> Task:
    return Task(KIND, ({"state": number},), 1)


def test_one_observation_is_under_way_at_a_time() -> None:
    """The next one is sent after the answer; its time holds the wait, as that of a queue."""
    with held() as (runner, server):
        first, second = submitted(runner, 1), submitted(runner, 2)
        assert server.heard.get(timeout=START_S) == 1
        time.sleep(SHORT_S)
        assert server.heard.empty()
        server.may_answer.release()
        assert first.result(START_S).value == {"number": 1}
        assert server.heard.get(timeout=START_S) == 2
        server.may_answer.release()
        late = second.result(START_S)
        assert late.value == {"number": 2}
        assert late.queue_s is not None
        assert late.queue_s >= SHORT_S


def test_a_full_queue_is_busy() -> None:
    """Beyond IN_TURN_MAX observations nothing is kept."""
    with held() as (runner, _):
        kept = [submitted(runner, number) for number in range(IN_TURN_MAX)]
        refused = submitted(runner, 99).result(START_S)
        assert isinstance(refused.failure, CloudBusy)
        assert not refused.started
        assert not any(one.done() for one in kept)


def test_the_answer_to_a_cancelled_task_is_ignored() -> None:
    """Its future ends at once. The site takes no task until that answer has come, and then goes on."""
    with held() as (runner, server):
        task = task_of(1)
        cancelled = runner.submit(task, START_S)
        assert server.heard.get(timeout=START_S) == 1
        runner.cancel(task)
        one = cancelled.result(START_S)
        assert isinstance(one.failure, Overtaken)
        assert one.censored
        assert one.started
        assert "came too late" in str(runner.unavailable(KIND))
        server.may_answer.release()
        until(lambda: runner.unavailable(KIND) is None)
        server.may_answer.release()
        assert submitted(runner, 2).result(START_S).value == {"number": 2}
        assert server.connections == 1


def test_a_task_that_waits_can_be_cancelled_and_expire() -> None:
    """It was never sent, so it never ran."""
    with held() as (runner, server):
        submitted(runner, 1)
        task = task_of(2)
        waiting, short = runner.submit(task, START_S), submitted(runner, 3, SHORT_S)
        runner.cancel(task)
        assert isinstance(waiting.result(START_S).failure, Overtaken)
        assert isinstance(short.result(START_S).failure, CloudTimeout)
        assert not waiting.result().started
        assert not short.result().started
        assert short.result().bytes_out == 0
        server.may_answer.release()
        assert server.heard.get(timeout=START_S) == 1
        last = submitted(runner, 4)
        server.may_answer.release()
        assert last.result(START_S).value == {"number": 4}


def test_an_answer_that_never_comes_does_not_keep_the_connection(monkeypatch: pytest.MonkeyPatch) -> None:
    """After OWED_MAX_S the robot connects again, and the server is used again."""
    monkeypatch.setattr(conversation, "OWED_MAX_S", SHORT_S)
    with held() as (runner, server):
        one = submitted(runner, 1, SHORT_S).result(START_S)
        assert isinstance(one.failure, CloudTimeout)
        until(lambda: server.connections == 2 and runner.unavailable(KIND) is None)
        server.may_answer.release(2)
        assert submitted(runner, 2).result(START_S).value == {"number": 2}


def test_close_ends_the_tasks_in_flight() -> None:
    """Their futures have an execution, later ones are cancelled, and the second close does nothing."""
    with held() as (runner, server):
        sent, waiting = submitted(runner, 1), submitted(runner, 2)
        assert server.heard.get(timeout=START_S) == 1
        began_s = time.monotonic()
        runner.close()
        assert time.monotonic() - began_s < 2.0
        assert isinstance(sent.result(START_S).failure, CloudBroken)
        assert sent.result().started
        assert not waiting.result(START_S).started
        assert submitted(runner, 3).cancelled()
        runner.close()
        runner.hurry()
        assert runner.unavailable(KIND) == "closed"


def test_a_closed_runner_leaves_nothing() -> None:
    """Neither threads nor files, connected or not."""
    with serving(stays) as endpoint:
        for _ in range(2):
            opened(endpoint)
        threads, files = left()  # some may be those of an earlier test that are ending
        for _ in range(5):
            opened(endpoint.replace("127.0.0.1", "localhost"))
        until(lambda: left()[0] <= threads and left()[1] <= files)


def opened(endpoint: str) -> None:
    """Connect, also to a port where nothing listens, and close."""
    with (
        closing(PolicyServerRunner(endpoint, site="gpu", heartbeat_s=0.01)) as runner,
        closing(PolicyServerRunner("ws://localhost:9", site="other")),
    ):
        until(lambda: runner.condition().round_trip_s is not None)


def test_a_command_takes_a_policy_server(tmp_path: Path) -> None:
    """`loadgen call --site gpu=ws://...` runs its tasks there; the trace names the site."""
    trace, module = tmp_path / "trace.jsonl", "tests.integration.openpi.robot"
    with serving(says(pack({"by": "gpu"}))) as endpoint:
        command = [
            sys.executable,
            "-m",
            "offboard.loadgen",
            "call",
            "--task",
            f"{module}:act",
            "--tasks",
            "12",
        ]
        command += ["--inputs", f"{module}:inputs", "--site", f"gpu={endpoint}", "--trace", str(trace)]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=50, check=False)
    assert done.returncode == 0, done.stderr
    used = [json.loads(line)["used"] for line in trace.read_text().splitlines()]
    assert len(used) == 12
    assert "gpu" in used


def test_without_heartbeats_nothing_is_measured() -> None:
    """A runner with `heartbeat_s=0` sends observations only."""
    with held() as (runner, server):
        server.may_answer.release()
        assert submitted(runner, 1).result(START_S).ok
        assert runner.condition().round_trip_s is None


def test_the_quality_of_a_policy_server_counts() -> None:
    """It has no function on the robot: `variants` names None for it, and the record has both qualities."""
    server = Held()
    server.may_answer.release(100)
    with serving(server.talk) as endpoint, Offloader.connect(sites={"gpu": endpoint}) as offload:
        assert offload.wait_for_sites(graded, START_S) == {}
        assert offload(graded, {"state": 3}, where="gpu") == {"number": 3}
        assert offload(graded, {"state": 3}, where="onboard") == {"number": -3}
        assert offload.last is not None
        assert {site: one.quality.value for site, one in offload.last.sites.items()} == {
            "gpu": 1.0,
            "onboard": 0.7,
        }
