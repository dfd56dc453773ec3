"""A task that harms its worker process loses only its own answer."""

import contextlib
import importlib
import os
import re
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent import futures
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from offboard.cloud_server.executors import worker
from offboard.cloud_server.executors.executor import Call, Outcome
from offboard.cloud_server.executors.worker_pool import WorkerPool
from offboard.common.errors import CloudTimeout, TaskFailed
from offboard.common.wire.messages import decode, encode
from offboard.loadgen.testbed.local_testbed import LocalTestbed
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.sites.runner import CLOUD
from tests import crashes
from tests.probes import echo, nap, process_id

pytestmark = [pytest.mark.integration, pytest.mark.timeout(120)]

MODULES = ("tests.probes", "tests.crashes")
START_S = 90.0  # may include compiling the planner
WAIT_S = 20.0
REPLACED_S = 2.0  # from a crash until another worker takes tasks
BUDGET_S = 0.3
MIB = 1 << 20
GIB = 1 << 30


@pytest.fixture(autouse=True)
def kinds() -> None:
    for module in MODULES:
        importlib.import_module(module)


@pytest.fixture
def make() -> Iterator[Callable[..., WorkerPool]]:
    made: list[WorkerPool] = []

    def start(count: int = 2, *more: str, memory: int = GIB, changes: list[str] | None = None) -> WorkerPool:
        executor = WorkerPool(count, [*MODULES, *more], MIB, memory)
        made.append(executor)
        executor.warm((changes if changes is not None else []).append).result(START_S)
        return executor

    yield start
    for executor in made:
        executor.close()


def submit(executor: WorkerPool, kind: str, *args: Any, **limits: Any) -> Any:
    return executor.submit(Call(kind, encode(args).frames, **limits), lambda _: None)


def run(executor: WorkerPool, kind: str, *args: Any, **limits: Any) -> Outcome:
    outcome = submit(executor, kind, *args, **limits).result(WAIT_S)
    assert isinstance(outcome, Outcome)
    return outcome


def value(outcome: Outcome) -> Any:
    assert outcome.status == "ok", outcome.error
    return decode(outcome.frames, [], {})


def until(done: Callable[[], bool], what: str) -> float:
    """Wait until `done`; returns the seconds that it took."""
    began = time.monotonic()
    while not done():
        assert time.monotonic() - began < WAIT_S, f"{what}: not within {WAIT_S:g} s"
        time.sleep(0.002)
    return time.monotonic() - began


def gone(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return False


@pytest.mark.parametrize(
    ("kind", "args", "how", "server_fault"),
    [
        ("segfault", (), "was killed by signal SIGSEGV", False),
        ("leave", (3,), "left with exit code 3", False),
        ("leave", (0,), "left with exit code 0", False),
        ("leave_a_child", (5.0,), "left with exit code 4", False),
        ("kill_itself", (int(signal.SIGABRT),), "was killed by signal SIGABRT", False),
        ("kill_itself", (int(signal.SIGRTMIN) + 1,), "was killed by signal 35", False),
        ("kill_itself", (int(signal.SIGKILL),), "was killed by signal SIGKILL", True),
    ],
)
def test_a_crash_fails_its_own_task_alone(
    make: Callable[..., WorkerPool], kind: str, args: tuple[Any, ...], how: str, server_fault: bool
) -> None:
    """The task fails with the reason, the other running task is answered, and a new worker starts soon.

    The workers load the planner, whose compiled code is in the cache.
    """
    changes: list[str] = []
    executor = make(2, "offboard.common.planning.planner", changes=changes)
    at_the_same_time = submit(executor, "nap", 0.5)
    outcome = run(executor, kind, *args)
    assert (outcome.status, outcome.error) == ("failed", f"the worker {how} while this task ran")
    assert (outcome.crashed, outcome.server_fault, outcome.cpu_s) == (True, server_fault, None)
    replaced_s = outcome.run_s + until(lambda: executor.up == 2, "another worker")
    assert value(run(executor, "echo", 1)) == 1
    assert replaced_s <= REPLACED_S, f"{replaced_s:.2f} s"
    assert value(at_the_same_time.result(WAIT_S)) == 0.5
    both = [submit(executor, "nap", 0.2) for _ in range(2)]
    assert [value(one.result(WAIT_S)) for one in both] == [0.2, 0.2]
    until(lambda: len(changes) == 5, "another spare one")
    assert changes == ["", "", "", "signal" if "signal" in how else "exit", ""]


def test_too_much_memory_is_an_ordinary_failure(make: Callable[..., WorkerPool]) -> None:
    """A task that asks for 10 GB fails and its worker goes on; so does one whose result needs too much."""
    executor = make(1)
    pid = value(run(executor, "process_id"))
    outcome = run(executor, "grab", 10 * GIB)
    assert (outcome.status, outcome.crashed, outcome.server_fault) == ("failed", False, False)
    assert "MemoryError: Unable to allocate 10.0 GiB" in outcome.error
    assert value(run(executor, "grab", 200 * MIB)) == 200 * MIB
    assert value(run(executor, "process_id")) == pid
    outcome = run(executor, "large", int(0.6 * GIB))
    assert (outcome.status, outcome.crashed, outcome.server_fault) == ("failed", False, True)
    assert outcome.error == "MemoryError: too little memory is left for an answer"
    until(lambda: executor.up == 1, "another worker")
    assert value(run(executor, "large", 200 * MIB)).nbytes == 200 * MIB


def test_a_task_that_fills_all_memory_is_answered(make: Callable[..., WorkerPool]) -> None:
    """The answer comes even if no memory is left; the worker is replaced if necessary."""
    executor = make(1, memory=256 * MIB)
    for _ in range(3):
        outcome = run(executor, "fill")
        assert (outcome.status, outcome.crashed) == ("failed", False), outcome.error
        assert outcome.error.startswith("MemoryError:")
        until(lambda: executor.up == 1, "another worker")
    assert value(run(executor, "echo", 1)) == 1


def test_a_worker_that_keeps_too_much_memory_is_replaced(make: Callable[..., WorkerPool]) -> None:
    """If a task keeps more than half of the memory, the next task may fail; then the worker is replaced."""
    changes: list[str] = []
    executor = make(1, changes=changes)
    pid = value(run(executor, "hoard", 700 * MIB))
    outcome = run(executor, "hoard", 700 * MIB)
    assert outcome.status == "failed"
    assert "MemoryError: Unable to allocate 700. MiB" in outcome.error
    until(lambda: executor.up == 1, "another worker")
    assert value(run(executor, "hoard", 700 * MIB)) != pid
    until(lambda: len(changes) == 4, "another spare one")
    assert changes == ["", "", "memory", ""]


def test_an_endless_task_is_killed_after_its_budget(make: Callable[..., WorkerPool], tmp_path: Path) -> None:
    """It is killed even if it ignores signals; the answer gives the reason, and another worker starts."""
    changes: list[str] = []
    executor = make(1, changes=changes)
    outcome = run(executor, "spin", str(tmp_path / "begun"), budget_s=BUDGET_S)
    assert outcome.status == "failed"
    assert outcome.error == "the worker was killed 1 s after the budget was over while this task ran"
    assert (outcome.crashed, outcome.server_fault) == (True, True)
    assert outcome.run_s >= BUDGET_S + worker.OVERTIME_S
    until(lambda: executor.up == 1, "another worker")
    assert value(run(executor, "echo", 5)) == 5
    until(lambda: len(changes) == 4, "another spare one")
    assert changes == ["", "", "budget", ""]


@pytest.mark.parametrize("why", ["cancelled", "budget over"])
def test_a_task_that_checks_keeps_its_worker(
    make: Callable[..., WorkerPool], tmp_path: Path, why: str
) -> None:
    """A task that calls `check_wanted` stops if cancelled or too late; the next task is not affected."""
    executor, begun = make(1), tmp_path / "begun"
    pid, wanted = value(run(executor, "process_id")), [True]
    budget_s = BUDGET_S if why == "budget over" else WAIT_S
    future = submit(executor, "look", str(begun), wanted=lambda: wanted[0], budget_s=budget_s)
    until(begun.exists, "the task")
    wanted[0] = why == "budget over"
    outcome = future.result(WAIT_S)
    assert outcome.error.startswith("Unwanted: nobody waits")
    assert (outcome.crashed, outcome.server_fault) == (False, True)
    assert value(run(executor, "process_id")) == pid
    wanted[0] = True
    future = submit(executor, "look", str(begun), wanted=lambda: wanted[0])
    with pytest.raises(futures.TimeoutError):
        future.result(5 * worker.LOOK_S)
    wanted[0] = False
    assert future.result(WAIT_S).error.startswith("Unwanted")


def test_an_idle_worker_that_is_killed_is_replaced(make: Callable[..., WorkerPool]) -> None:
    """`kill -9` between two tasks costs no task."""
    changes: list[str] = []
    executor = make(changes=changes)
    pid = value(run(executor, "process_id"))
    os.kill(pid, signal.SIGKILL)
    until(lambda: changes[3:] == ["signal"], "noticed")
    assert value(run(executor, "process_id")) != pid
    until(lambda: changes[3:] == ["signal", ""], "another worker")


def test_all_tasks_are_answered_while_workers_die(make: Callable[..., WorkerPool]) -> None:
    """Workers are killed at any moment; still every future gets an answer or the reason for having none."""
    executor = make(2)
    outcomes: list[Outcome] = []
    ending = time.monotonic() + 3.0
    while time.monotonic() < ending:
        if len(outcomes) % 50 == 49:
            with contextlib.suppress(ProcessLookupError):
                os.kill(executor.pids[len(outcomes) // 50 % 2], signal.SIGKILL)
        outcomes.append(run(executor, "echo", len(outcomes)))
        if executor.up == 0:
            until(lambda: executor.up > 0, "another worker")
    statuses = {outcome.status for outcome in outcomes}
    assert "ok" in statuses
    assert statuses <= {"ok", "busy", "failed"}
    for n, outcome in enumerate(outcomes):
        if outcome.status == "ok":
            assert value(outcome) == n
        elif outcome.status == "failed":
            assert "SIGKILL" in outcome.error


@pytest.mark.parametrize(
    ("body", "error"),
    [
        ("import os; os._exit(3)", "one left with exit code 3"),
        ("import ctypes; ctypes.string_at(0)", "one was killed by signal SIGSEGV"),
        (
            "raise ValueError('no map')",
            "one did not start: ConfigError: task module 'breaks_at_start' cannot",
        ),
    ],
)
def test_a_crash_during_warm_up_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, body: str, error: str
) -> None:
    """If workers cannot start, `warm` fails with the reason instead of trying again."""
    (tmp_path / "breaks_at_start.py").write_text(body)
    monkeypatch.syspath_prepend(tmp_path)
    executor = WorkerPool(2, ["breaks_at_start"], MIB)
    with contextlib.closing(executor), pytest.raises(Exception, match=re.escape(error)):
        executor.warm().result(WAIT_S)


def test_a_failed_restart_is_repeated(
    make: Callable[..., WorkerPool], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """There is a pause between two attempts, and the other workers go on."""
    monkeypatch.setattr(worker, "FAILED_PAUSE_S", 0.1)
    (tmp_path / "starts_sometimes.py").write_text(
        "import pathlib\n"
        f"if pathlib.Path({str(tmp_path / 'bad')!r}).exists():\n"
        "    raise RuntimeError('not now')\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    changes: list[str] = []
    executor = make(2, "starts_sometimes", changes=changes)
    (tmp_path / "bad").touch()
    for _ in range(2):
        run(executor, "segfault")
    until(lambda: changes.count("start") >= 3, "several tries")
    assert executor.up == 1
    assert value(run(executor, "echo", 1)) == 1
    (tmp_path / "bad").unlink()
    until(lambda: executor.up == 2, "another worker")


def test_nothing_is_left_after_close(make: Callable[..., WorkerPool], tmp_path: Path) -> None:
    """No process, thread or open file is left, even if one task never ends and one worker has just died."""
    before = len(list(Path("/proc/self/fd").iterdir())), threading.active_count()
    executor = make(3)
    pids = executor.pids
    endless = submit(executor, "spin", str(tmp_path / "begun"))
    until((tmp_path / "begun").exists, "the task")
    run(executor, "segfault")
    executor.close()
    executor.close()
    assert endless.result(0).error == "the worker was ended with the server while this task ran"
    assert [gone(pid) for pid in pids] == [True] * 4
    assert (len(list(Path("/proc/self/fd").iterdir())), threading.active_count()) == before
    assert not executor.blob_folder.exists()


def test_an_idle_worker_ends_by_itself(
    make: Callable[..., WorkerPool], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`close` lets a module run its exit handlers."""
    (tmp_path / "tidies_up.py").write_text(
        f"import atexit, pathlib\natexit.register(pathlib.Path({str(tmp_path / 'tidy')!r}).touch)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    make(1, "tidies_up").close()
    assert (tmp_path / "tidy").exists()


def test_large_arguments_and_results_cross_the_pipe(make: Callable[..., WorkerPool]) -> None:
    """40 MB cross in each direction, and small values after them."""
    executor, numbers = make(1), np.arange(5_000_000)
    np.testing.assert_array_equal(value(run(executor, "echo", numbers)), numbers)
    assert value(run(executor, "echo", [1, b"2", None])) == [1, b"2", None]


def test_a_robot_gets_the_reason_and_others_are_served(
    testbed: Callable[..., LocalTestbed], connect: Callable[..., Offloader], tmp_path: Path
) -> None:
    """Crashes and 10 GB raise TaskFailed at the robot, and an endless loop is too late; none runs onboard.

    At the same time the cloud answers the tasks of another robot.
    """
    bed = testbed({"executor": "processes", "workers": 2, "tasks": ",".join(MODULES)})
    offload, other = (connect(bed, policy=CLOUD, timeout_s=WAIT_S) for _ in range(2))
    workers = {other(process_id)}
    for fatal, args, reason in (
        (crashes.segfault, (), "the worker was killed by signal SIGSEGV while this task ran"),
        (crashes.leave, (3,), "the worker left with exit code 3 while this task ran"),
        (crashes.grab, (10 * GIB,), "MemoryError: Unable to allocate 10.0 GiB"),
    ):
        answers: list[float] = []
        at_the_same_time = threading.Thread(target=lambda: answers.append(other(nap, 0.5)))  # noqa: B023
        at_the_same_time.start()
        time.sleep(0.1)
        with pytest.raises(TaskFailed, match=re.escape(reason)):
            offload(fatal, *args)
        at_the_same_time.join()
        assert answers == [0.5]
        assert other.last is not None
        assert (other.last.used, len(other.last.executions)) == (CLOUD, 1)
    with pytest.raises(CloudTimeout):
        offload(crashes.spin, str(tmp_path / "begun"), timeout_s=1.0)
    until(lambda: 'restarts_total{reason="budget"} 1' in metrics(bed), "the endless task killed")
    assert 'restarts_total{reason="signal"} 1' in metrics(bed)
    assert 'restarts_total{reason="exit"} 1' in metrics(bed)
    assert offload(echo, 1) == 1
    assert offload.last is not None
    assert offload.last.used == CLOUD
    workers.add(offload(process_id))
    assert os.getpid() not in workers


def metrics(bed: LocalTestbed) -> str:
    return httpx.get(f"http://{bed.parts['cloud'].http}/metrics").text
