"""`@task(setup=...)`: each worker makes its state once, whatever happens to the tasks."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from queue import SimpleQueue

import pytest

from offboard import Offloader
from offboard.cloud_server.executors import EXECUTORS, Executor
from offboard.cloud_server.executors.worker_pool import WorkerPool
from offboard.common.errors import OffloadError
from offboard.common.tasks import task
from offboard.robot_client.policies import BOTH
from offboard.robot_client.records.record import Record
from offboard.robot_client.sites.runner import CLOUD, ONBOARD
from tests import stateful_tasks
from tests.executor_tasks import ON_THIS_COMPUTER, call, run, value
from tests.integration.server.peers import WAIT_S, Serve
from tests.stateful_tasks import Engine, engine_twice

pytestmark = pytest.mark.integration

WORKERS = 2
TASKS = 40
BROKEN = """from offboard.common.tasks import task


def find(path):
    raise FileNotFoundError(f"no model in {path}")


def load():
    return find("models")


@task("find_things", size=float, WHEN=load)
def find_things(model, number=0):
    return number
"""
SETUP_S = 0.5  # long: a busy machine may delay a task of 2 ms


@task("plain_twice", size=float)
def plain_twice(number: int) -> int:
    return 2 * number


@pytest.fixture
def make() -> Iterator[Callable[..., Executor]]:
    """Makes executors that know the task with the engine; counts engines from 0."""
    Engine.made = 0
    made = []

    def start(name: str, changed: Callable[[str], None] = lambda _: None) -> Executor:
        made.append(EXECUTORS[name](WORKERS, ["tests.stateful_tasks"], 2**20))
        made[-1].warm(changed).result(WAIT_S)
        return made[-1]

    yield start
    for one in made:
        one.close()


def test_threads_share_as_many_states_as_there_are_workers(make: Callable[..., Executor]) -> None:
    """All are made during the warm-up. Each serves one task at a time, and none is added later."""
    executor = make("threads")
    assert Engine.made == WORKERS
    used = set()
    for number in range(20):
        futures = [executor.submit(call("engine_twice", number, 1), lambda _: None) for _ in range(WORKERS)]
        for future in futures:
            twice, _, engine, _ = value(future.result(WAIT_S))
            assert twice == 2 * number
            used.add(engine)
    assert used == {1, 2}
    assert Engine.made == WORKERS


def test_each_worker_process_has_one_state(make: Callable[..., Executor]) -> None:
    """Each makes it during its own warm-up, and so does the process that replaces one that died."""
    changes: SimpleQueue[str] = SimpleQueue()
    executor = make("processes", changes.put)
    assert isinstance(executor, WorkerPool)
    _, first, _, made = value(run(executor, "engine_twice", 1, 1))
    assert made == 1
    os.kill(first, signal.SIGKILL)
    while changes.get(timeout=WAIT_S) != "signal":
        pass
    while changes.get(timeout=WAIT_S) != "":  # the replacement is up
        pass
    seen = set()
    for _ in range(5):
        futures = [executor.submit(call("engine_twice", 1, 1), lambda _: None) for _ in range(WORKERS)]
        for future in futures:
            _, process, _, made = value(future.result(WAIT_S))
            assert made == 1
            seen.add(process)
    assert first not in seen
    assert Engine.made == 0


def test_probes_hedges_and_cancelled_runs_make_no_further_state(serve: Serve) -> None:
    """After many calls from several threads, the robot has one state, and the server one per worker."""
    Engine.made = 0
    server = serve(workers=WORKERS)
    assert Engine.made == WORKERS
    with Offloader.connect(server.server.endpoint) as offload:
        assert not offload.wait_for_sites(engine_twice, WAIT_S)
        assert Engine.made == WORKERS + 1
        ways = [None, BOTH, ONBOARD, CLOUD]
        with ThreadPoolExecutor(3) as pool:
            found = list(
                pool.map(lambda n: offload(engine_twice, n, scale=2, where=ways[n % 4])[0], range(TASKS))
            )
        assert found == [4 * n for n in range(TASKS)]
        assert [one[0] for one in offload.map(engine_twice, [(n, 3) for n in range(TASKS)])] == [
            6 * n for n in range(TASKS)
        ]
    assert Engine.made == WORKERS + 1


def test_no_setup_time_is_recorded(serve: Serve, monkeypatch: pytest.MonkeyPatch) -> None:
    """If the first call starts the setup onboard, its caller waits for it, but no time of the task has it."""
    monkeypatch.setattr(stateful_tasks, "SETUP_S", SETUP_S)
    server, records = serve(), list[Record]()
    with Offloader.connect(server.server.endpoint, policy="paper", observers=[records.append]) as offload:
        assert not offload.wait_for_sites(plain_twice, WAIT_S)
        before = Engine.made
        offload(engine_twice, 1, where=BOTH)
        assert Engine.made == before + 1
    assert records[0].waited_s >= SETUP_S
    for one in records[0].executions:
        print(one)
        assert one.seconds < SETUP_S
        assert (one.queue_s or 0.0) < SETUP_S
        assert (one.run_s or 0.0) < SETUP_S


@pytest.mark.parametrize("name", ON_THIS_COMPUTER)
def test_a_setup_that_raises_stops_the_server(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The error names the task and the cause."""
    monkeypatch.setenv("BREAK_ENGINE", "1")
    executor = EXECUTORS[name](1, ["tests.stateful_tasks"], 2**20)
    with (
        closing(executor),
        pytest.raises(OffloadError, match="setup of task engine_twice: RuntimeError: no engine"),
    ):
        executor.warm().result(WAIT_S)


@pytest.mark.parametrize("name", ON_THIS_COMPUTER)
@pytest.mark.parametrize("when", ["setup", "warm"])
def test_the_log_shows_where_a_setup_raised(tmp_path: Path, name: str, when: str) -> None:
    """The last line names task and error; above it are the frames of the user, and none of Offboard."""
    (tmp_path / "broken.py").write_text(BROKEN.replace("WHEN", when))
    command = [sys.executable, "-m", "offboard.cloud_server", "--tasks", "broken", "--executor", name]
    command += ["--workers", "1", "--listen", "tcp://127.0.0.1:0", "--http", "127.0.0.1:0"]
    done = subprocess.run(
        [*command, "--log", "error"], capture_output=True, text=True, cwd=tmp_path, timeout=6 * WAIT_S
    )
    assert done.returncode == 1, done.stderr
    first, *shown, last = done.stderr.splitlines()
    cause = "FileNotFoundError: no model in models"
    assert last == f"cloud-server: {when} of task find_things: {cause}"
    assert first.endswith(": the server cannot start; remedy: correct the setup of that task")
    assert shown[0] == "Traceback (most recent call last):"
    assert shown[-1] == cause
    files = [line for line in shown if line.startswith("  File ")]
    assert [line.rpartition(" ")[2] for line in files] == ["load", "find"]
    assert all("broken.py" in line for line in files)
