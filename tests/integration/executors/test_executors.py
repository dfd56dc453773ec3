"""The contract of executors, for each of them."""

import os
import threading
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import numpy as np
import pytest

from offboard.cloud_server.executors import EXECUTORS, Executor
from offboard.cloud_server.executors.executor import Call, Outcome
from offboard.common.wire.values import encode
from tests.executor_tasks import ON_THIS_COMPUTER, WAIT_S, call, run, run_joint, value
from tests.wire_values import Pose

pytestmark = pytest.mark.integration

BURNT_S = 0.2
TOLERANCE_S = 0.05  # CPU time of other threads of the process


def test_a_task_runs_and_its_result_comes_back(executor: Executor) -> None:
    """Arrays in frames and in blobs reach the task; the outcome has the result and the run time."""
    for n in (10, 100_000):
        outcome = run(executor, "exec_sum", np.ones(n))
        assert value(outcome) == n
        assert outcome.run_s > 0
    echoed = value(run(executor, "exec_echo", {"a": [np.eye(3), b"raw", None]}))
    np.testing.assert_array_equal(echoed["a"][0], np.eye(3))


@pytest.mark.parametrize(
    ("kind", "args", "error"),
    [
        ("exec_raise", ["no such place"], "ValueError: no such place"),
        ("exec_exit", [], "SystemExit: 3"),
        ("exec_cancel", [], "CancelledError: late"),
        ("exec_mute", [], "Mute: (it has no readable text)"),
        (
            "exec_object",
            [],
            "BadValue: result: a value of type builtins.object cannot be sent; ",
        ),
        ("exec_deep", [], "BadValue: result['a'][1]: a value of type builtins.object cannot be sent; "),
        ("exec_echo", [1, 2], "TypeError: exec_echo() takes 1 positional argument but 2 were given"),
        ("exec_unheard_of", [], "UnknownTask: no task named 'exec_unheard_of'; known:"),
    ],
)
def test_what_a_task_raises_is_its_outcome(
    executor: Executor, kind: str, args: list[Any], error: str
) -> None:
    """The outcome is `failed` with the type and text of the exception; the worker goes on."""
    outcome = run(executor, kind, *args)
    assert outcome.status == "failed"
    assert outcome.error.startswith(error)
    of_the_values = error.startswith(("BadValue", "UnknownTask"))
    assert outcome.server_fault == of_the_values
    assert bool(outcome.traceback) != of_the_values
    assert value(run(executor, "exec_echo", 1)) == 1


def test_a_kind_that_packs_gets_its_arguments_unpacked(executor: Executor) -> None:
    """The one value that was sent becomes all arguments."""
    assert value(run(executor, "exec_packed", {"a": 1, "b": [2]})) == [1, [2]]


def test_calls_that_run_together_have_their_own_outcomes(executor: Executor) -> None:
    """In their order, with their blobs; one with another key runs alone."""
    arrays = [np.full(10, 1.0), np.full(100_000, 2.0), np.full((2, 3), 3.0), np.full(10, 4.0)]
    outcomes = run_joint(executor, "exec_joint", *arrays)
    assert [value(one) for one in outcomes] == [[10.0, 3], [200_000.0, 3], [18.0, 1], [40.0, 3]]
    assert [one.together for one in outcomes] == [3, 3, 1, 3]


def test_a_raising_run_is_repeated_one_by_one(executor: Executor) -> None:
    """Only the call that raises alone fails, and the outcome says what happened."""
    outcomes = run_joint(executor, "exec_joint", np.ones(2), np.ones(0), np.ones(3))
    assert [one.status for one in outcomes] == ["ok", "failed", "ok"]
    assert outcomes[1].error == "ValueError: empty"
    assert "in sums" in outcomes[1].traceback
    assert [value(one) for one in (outcomes[0], outcomes[2])] == [[2.0, 1], [3.0, 1]]
    assert outcomes[0].note == "a run of 3 requests failed, so each runs alone: ValueError: empty"


@pytest.mark.parametrize(
    ("kind", "args", "error"),
    [
        ("exec_bad_unpack", ["x"], "unpack of task exec_bad_unpack: ValueError: no picture: x"),
        ("exec_packed", [3], "unpack of task exec_packed: TypeError: 'int' object is not subscriptable"),
        ("exec_packed", [1, 2], "2 values for unpack of task exec_packed, which takes one"),
        ("exec_few_unpacked", [3], "unpack of task exec_few_unpacked returns other arguments: missing a"),
    ],
)
def test_a_failing_unpack_is_a_fault_of_the_server(
    executor: Executor, kind: str, args: list[Any], error: str
) -> None:
    """Onboard then answers. If the code of the user raised, its traceback is kept for the log."""
    outcome = run(executor, kind, *args)
    assert (outcome.status, outcome.server_fault) == ("failed", True)
    assert outcome.error.startswith(f"ProtocolError: {error}")
    assert ("in raise_value_error" in outcome.traceback) == (kind == "exec_bad_unpack")
    assert value(run(executor, "exec_echo", 1)) == 1


OTHER_FIELDS = bytes(encode([Pose(1, 2, [])], [Pose]).frames[0])  # here, Pose has x only


@pytest.mark.parametrize(
    "frames", [[b"\xc1"], [b"\x01"], [b"\x91\xd7\x01\x93\x01\xa3<i2\x91\x02"], [], [OTHER_FIELDS]]
)
def test_a_malformed_body_is_a_fault_of_the_server(executor: Executor, frames: list[bytes]) -> None:
    """Bytes that this side cannot read may be right for the robot, so onboard answers; no worker is lost."""
    outcome = executor.submit(Call("exec_pose", frames), lambda _: None).result(WAIT_S)
    assert (outcome.status, outcome.error.split(":")[0]) == ("failed", "ProtocolError")
    assert outcome.server_fault
    assert executor.up == executor.workers


def test_the_outcome_has_the_cpu_time(executor: Executor, tmp_path: Path) -> None:
    """Computing counts, also in a task that fails; waiting counts for almost nothing."""
    outcome = run(executor, "exec_burn", BURNT_S)
    burnt_s, pipe = value(outcome), tmp_path / "pipe"
    os.mkfifo(pipe)
    waiting = executor.submit(call("exec_wait_for_file", str(pipe)), lambda _: None)
    pipe.write_text("go")
    waited = waiting.result(WAIT_S)
    failed = run(executor, "exec_raise", "no such place")
    for name, one, expected_s in [("burn", outcome, burnt_s), ("wait", waited, 0), ("raise", failed, 0)]:
        assert one.cpu_s == pytest.approx(expected_s, abs=TOLERANCE_S), name
    assert run(executor, "exec_burn", 0.0).cpu_s > 0


def test_used_cpu_time_includes_the_workers(executor: Executor) -> None:
    """`used_s` counts what tasks compute, in this process and in worker processes."""
    before_s = executor.used_s()
    burnt_s = value(run(executor, "exec_burn", BURNT_S))
    used_s = executor.used_s() - before_s
    assert burnt_s <= used_s + TOLERANCE_S


def test_warm_workers_run_tasks_in_parallel(executor: Executor, tmp_path: Path) -> None:
    """Two workers run two tasks at the same time, and each ran `warm` once before."""
    pipes = [tmp_path / "a", tmp_path / "b"]
    futures = []
    for pipe in pipes:
        os.mkfifo(pipe)
        futures.append(executor.submit(call("exec_wait_for_file", str(pipe)), lambda _: None))
    for pipe in reversed(pipes):  # in reverse order: no task waits for the other one
        pipe.write_text(pipe.name)
    assert [value(future.result(WAIT_S)) for future in futures] == ["a", "b"]
    assert value(run(executor, "exec_where", 0))[1] == 1


def test_a_blob_is_the_same_array_each_time(make: Callable[..., Executor]) -> None:
    """So a task can find a prepared map again by the identity of its array."""
    for name in ON_THIS_COMPUTER:
        executor = make(name)
        same = call("exec_where", np.ones(100_000))
        seen = {value(executor.submit(same, lambda _: None).result(WAIT_S))[2] for _ in range(3)}
        assert len(seen) == 1


def test_processes_and_threads_run_where_they_say(make: Callable[..., Executor]) -> None:
    """`threads` runs tasks in this process, `processes` in another one."""
    assert value(run(make("threads"), "exec_where", 0))[0] == os.getpid()
    assert value(run(make("processes"), "exec_where", 0))[0] != os.getpid()


def test_an_unwanted_task_stops_early(executor: Executor, tmp_path: Path) -> None:
    """A task that calls `check_wanted` stops, and its worker can take the next task."""
    begun, wanted = tmp_path / "begun", threading.Event()
    os.mkfifo(begun)
    wanted.set()
    future = executor.submit(call("exec_look", str(begun), wanted=wanted.is_set), lambda _: None)
    assert begun.read_text() == "begun"
    wanted.clear()
    assert future.result(WAIT_S).error.startswith("Unwanted: ")
    assert value(run(executor, "exec_echo", 3)) == 3


def test_closing_ends_all_idle_threads(module: str) -> None:
    """A thread that ends together with the process can crash it (SIGABRT)."""
    for _ in range(20):
        before = set(threading.enumerate())
        executor = EXECUTORS["threads"](3, [module], 1000)
        assert value(run(executor, "exec_where", 0))
        executor.close()
        assert set(threading.enumerate()) - before == set()


def test_run_executes_in_the_calling_thread(make: Callable[..., Executor], tmp_path: Path) -> None:
    """With threads, the task runs here while another thread runs `meanwhile`."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    executor, threads = make("threads"), list[int]()

    def meanwhile() -> None:
        threads.append(threading.get_ident())
        pipe.write_text("done")

    outcome = executor.run(call("exec_wait_for_file", str(pipe)), meanwhile=meanwhile)
    assert outcome is not None
    assert value(outcome) == "done"
    assert threads != [threading.get_ident()]


def test_a_worker_pool_does_not_run_in_the_calling_thread(make: Callable[..., Executor]) -> None:
    """Then `run` returns None and does not run `meanwhile`."""
    done = list[int]()
    executor = make("processes")
    assert executor.run(call("exec_exit"), meanwhile=lambda: done.append(1)) is None
    assert done == []


def test_done_is_called_once_for_every_task(executor: Executor) -> None:
    """It gets the future that `submit` returned."""
    done: SimpleQueue[Future[Outcome]] = SimpleQueue()
    returned = executor.submit(call("exec_echo", "text"), done.put)
    assert done.get(timeout=WAIT_S) is returned
    assert value(returned.result(WAIT_S)) == "text"
    assert done.empty()
