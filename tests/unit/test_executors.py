"""The executor contract, for every executor, and what is particular to worker processes."""

import hashlib
import importlib
import os
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, wait
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import numpy as np
import pytest

from offboard.cloud_server.executors import EXECUTORS, SPARES, Executor, Outcome, Processes
from offboard.common.wire.messages import StoredBlob, decode, encode

WAIT_S = 8
BURNT_S = 0.2
TOLERANCE_S = 0.05  # the CPU time of whatever else the process does meanwhile
ROOT = Path(__file__).parents[2]
MODULE = '''
import asyncio, os, pathlib, threading, time
from offboard.common.tasks import task
from offboard.common.wanted import check_wanted

warmed = []

@task("exec_sum", size=lambda array: array.size, warm=lambda: warmed.append(1))
def exec_sum(array):
    return float(array.sum())

@task("exec_where", size=lambda array: 0)
def exec_where(array):
    """Process, times warmed, identity of the array."""
    return [os.getpid(), len(warmed), id(array)]

@task("exec_raise", size=lambda text: 0)
def exec_raise(text):
    raise ValueError(text)

@task("exec_exit", size=lambda: 0)
def exec_exit():
    raise SystemExit(3)

@task("exec_cancel", size=lambda: 0)
def exec_cancel():
    raise asyncio.CancelledError("late")

class Mute(Exception):
    def __str__(self):
        raise RuntimeError

@task("exec_mute", size=lambda: 0)
def exec_mute():
    raise Mute

@task("exec_object", size=lambda: 0)
def exec_object():
    return object()

@task("exec_echo", size=lambda value: 0)
def exec_echo(value):
    return value

@task("exec_wait_for_file", size=lambda path: 0)
def exec_wait_for_file(path):
    with open(path) as pipe:  # a named pipe: opening waits for the writer
        return pipe.read()

@task("exec_burn", size=lambda seconds: seconds)
def exec_burn(seconds):
    """Computes until its thread has used so many CPU seconds; those it did use."""
    start = time.thread_time()
    while (used := time.thread_time() - start) < seconds:
        pass
    return used

@task("exec_look", size=lambda path: 0)
def exec_look(path):
    pathlib.Path(path).touch()
    while True:
        check_wanted()
        time.sleep(0.001)
'''


@pytest.fixture(scope="module")
def module(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    folder = tmp_path_factory.mktemp("tasks")
    (folder / "executor_tasks.py").write_text(MODULE)
    patch = pytest.MonkeyPatch()
    patch.syspath_prepend(folder)
    importlib.import_module("executor_tasks")
    yield "executor_tasks"
    patch.undo()


@pytest.fixture
def make(module: str) -> Iterator[Callable[..., Executor]]:
    made: list[Executor] = []

    def start(name: str, workers: int = 1, blob_bytes_max: int = 1_000_000) -> Executor:
        executor = EXECUTORS[name](workers, [module], blob_bytes_max)
        made.append(executor)
        executor.warm().result(WAIT_S)
        return executor

    yield start
    for executor in made:
        executor.close()


@pytest.fixture(scope="module", params=sorted(EXECUTORS))
def executor(request: pytest.FixtureRequest, module: str) -> Iterator[Executor]:
    """One warm executor of each name, two workers."""
    executor = EXECUTORS[request.param](2, [module], 1_000_000)
    executor.warm().result(WAIT_S)
    yield executor
    executor.close()


def run(executor: Executor, kind: str, *args: Any) -> Outcome:
    body = encode(args, blobs=True)
    blobs = {digest: StoredBlob(data) for digest, data in body.blobs.items()}
    return executor.submit(kind, body.frames, blobs).result(WAIT_S)


def value(outcome: Outcome) -> Any:
    assert outcome.status == "ok", outcome.error
    return decode(outcome.frames, [], {})


def test_a_task_runs_and_its_result_comes_back(executor: Executor) -> None:
    """Arrays in frames and in blobs reach the task; the outcome says how long it took."""
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
        ("exec_mute", [], "Mute: (its text cannot be had)"),
        (
            "exec_object",
            [],
            "BadValue: a value of type builtins.object cannot cross the wire",
        ),
        ("exec_echo", [1, 2], "TypeError: exec_echo() takes 1 positional argument but 2 were given"),
        ("exec_unheard_of", [], "UnknownTask: no task named 'exec_unheard_of'; known:"),
    ],
)
def test_what_a_task_raises_is_its_outcome(
    executor: Executor, kind: str, args: list[Any], error: str
) -> None:
    """Failed, with the type and text of what was raised; the worker lives on."""
    outcome = run(executor, kind, *args)
    assert outcome.status == "failed"
    assert outcome.error.startswith(error)
    assert value(run(executor, "exec_echo", 1)) == 1


@pytest.mark.parametrize("frames", [[b"\xc1"], [b"\x01"], [b"\x91\xd7\x01\x93\x01\xa3<i2\x91\x02"], []])
def test_an_unsound_body_fails_alone(executor: Executor, frames: list[bytes]) -> None:
    """Bytes that are no list of arguments give failed, and nothing else."""
    outcome = executor.submit("exec_echo", frames, {}).result(WAIT_S)
    assert (outcome.status, outcome.error.split(":")[0]) == ("failed", "ProtocolError")
    assert executor.up == executor.workers


def test_the_outcome_says_what_cpu_time_was_used(executor: Executor, tmp_path: Path) -> None:
    """What the task computed is counted, also where it failed, and hardly anything where it waited."""
    outcome = run(executor, "exec_burn", BURNT_S)
    burnt_s, pipe = value(outcome), tmp_path / "pipe"
    os.mkfifo(pipe)
    waiting = executor.submit("exec_wait_for_file", encode([str(pipe)]).frames, {})
    pipe.write_text("go")
    waited = waiting.result(WAIT_S)
    failed = run(executor, "exec_raise", "no such place")
    for name, one, expected_s in [("burn", outcome, burnt_s), ("wait", waited, 0), ("raise", failed, 0)]:
        assert one.cpu_s == pytest.approx(expected_s, abs=TOLERANCE_S), name
    assert run(executor, "exec_burn", 0.0).cpu_s > 0


def test_what_server_and_workers_used_is_told(executor: Executor) -> None:
    """All that it computes is its own, in whatever process."""
    before_s = executor.used_s()
    burnt_s = value(run(executor, "exec_burn", BURNT_S))
    used_s = executor.used_s() - before_s
    assert burnt_s <= used_s + TOLERANCE_S


def test_what_a_worker_used_that_died_is_told(make: Callable[..., Executor]) -> None:
    """Else what others use seemed to be so much more for a moment."""
    executor = make("processes")
    run(executor, "exec_burn", BURNT_S)
    worker, *_ = value(run(executor, "exec_where", 0))
    used_s = executor.used_s()
    os.kill(worker, signal.SIGKILL)
    until = time.monotonic() + WAIT_S
    while Path(f"/proc/{worker}").exists():  # it is waited for
        assert time.monotonic() < until
        time.sleep(0.01)
    assert executor.used_s() >= used_s


def test_every_worker_is_warm_and_tasks_run_side_by_side(executor: Executor, tmp_path: Path) -> None:
    """Two tasks that wait do so at once, and `warm` ran before the first task."""
    pipes = [tmp_path / "a", tmp_path / "b"]
    futures = []
    for pipe in pipes:
        os.mkfifo(pipe)
        futures.append(executor.submit("exec_wait_for_file", encode([str(pipe)]).frames, {}))
    for pipe in reversed(pipes):  # the later one first: neither waits for the other
        pipe.write_text(pipe.name)
    assert [value(future.result(WAIT_S)) for future in futures] == ["a", "b"]
    assert value(run(executor, "exec_where", 0))[1] == 1


def test_a_blob_is_the_same_array_each_time(make: Callable[..., Executor]) -> None:
    """A task that prepares a map once finds it again by identity, in every executor."""
    for name in sorted(EXECUTORS):
        executor = make(name)
        body = encode([np.ones(100_000)], blobs=True)
        blobs = {digest: StoredBlob(data) for digest, data in body.blobs.items()}
        seen = {value(executor.submit("exec_where", body.frames, blobs).result(WAIT_S))[2] for _ in range(3)}
        assert len(seen) == 1


def test_processes_are_others_and_threads_are_not(make: Callable[..., Executor]) -> None:
    """`threads` runs in the server's process, `processes` does not."""
    assert value(run(make("threads"), "exec_where", 0))[0] == os.getpid()
    assert value(run(make("processes"), "exec_where", 0))[0] != os.getpid()


def test_a_task_that_looks_stops_once_it_is_not_wanted(executor: Executor, tmp_path: Path) -> None:
    """Its worker is free for the next one."""
    begun, wanted = tmp_path / "begun", [True]
    body = encode([str(begun)])
    future = executor.submit("exec_look", body.frames, {}, lambda: wanted[0])
    while not begun.exists():
        time.sleep(0.001)
    wanted[0] = False
    assert future.result(WAIT_S).error.startswith("Unwanted: nobody waits")
    assert value(run(executor, "exec_echo", 3)) == 3


def test_the_spool_is_bounded_and_private_and_goes_away(make: Callable[..., Executor]) -> None:
    """Blob files are private, stay within the bound, and end with the executor."""
    executor = make("processes", blob_bytes_max=2_000_000)
    assert isinstance(executor, Processes)
    folder = executor._spool.folder
    assert folder.stat().st_mode & 0o077 == 0
    arrays = [np.full(100_000, n, float) for n in range(4)]
    for array in [*arrays, arrays[-1]]:
        assert value(run(executor, "exec_sum", array)) == array.sum()
        assert sum(file.stat().st_size for file in folder.iterdir()) <= 2_000_000
    kept = {file.name for file in folder.iterdir()}
    assert kept == {hashlib.sha256(array.tobytes()).hexdigest() for array in arrays[-2:]}
    executor.close()
    assert not folder.exists()


def test_no_room_for_a_blob_is_busy_not_the_end(make: Callable[..., Executor]) -> None:
    """When the blob cannot be written the task does not run here, and the next one does."""
    executor = make("processes")
    assert isinstance(executor, Processes)
    real, executor._spool.folder = executor._spool.folder, Path("/proc/nowhere")
    assert run(executor, "exec_sum", np.ones(100_000)).status == "busy"
    executor._spool.folder = real
    assert value(run(executor, "exec_sum", np.ones(100_000))) == 100_000
    assert executor._spool._pins == {}


def test_closing_does_not_wait_for_a_task_that_hangs(make: Callable[..., Executor], tmp_path: Path) -> None:
    """A hanging task is abandoned: its worker process is gone when `close` returns."""
    executor = make("processes")
    pid = value(run(executor, "exec_where", 0))[0]
    pipe = tmp_path / "never"
    os.mkfifo(pipe)
    hanging = executor.submit("exec_wait_for_file", encode([str(pipe)]).frames, {})
    executor.close()
    executor.close()
    assert hanging.result(WAIT_S).status != "ok"
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_closing_leaves_no_thread_that_can_end(module: str) -> None:
    """One that ends with the process may take it down (SIGABRT)."""
    for _ in range(20):
        before = set(threading.enumerate())
        executor = EXECUTORS["threads"](3, [module], 1000)
        assert value(run(executor, "exec_where", 0))
        executor.close()
        assert set(threading.enumerate()) - before == set()


def test_closing_while_workers_start_ends_them(module: str) -> None:
    """A server told to stop before it was ready stops."""
    executor = EXECUTORS["processes"](2, [module], 1000)
    starting = executor.warm()
    executor.close()
    wait([starting], WAIT_S)
    assert starting.done()


def test_workers_that_cannot_start_are_reported(module: str) -> None:
    """A task module that breaks in the worker gives one clear error, not a wait."""
    executor = EXECUTORS["processes"](2, [module, "no_such_module"], 1000)
    with pytest.raises(Exception, match="worker processes did not start"):
        executor.warm().result(WAIT_S)
    executor.close()


SERVER = """
import sys
from offboard.cloud_server.executors import Processes

if __name__ == "__main__":
    sys.path.insert(0, sys.argv[1])
    executor = Processes(2, [sys.argv[2]], 1000)
    executor.warm().result(8)
    print(*[worker.pid for worker in executor._workers], flush=True)
    sys.stdin.read()
"""


def test_workers_die_with_the_server(module: str, tmp_path: Path) -> None:
    """kill -9 of the server leaves no worker process behind."""
    script = tmp_path / "little_server.py"
    script.write_text(SERVER)
    folder = str(Path(importlib.import_module(module).__file__ or "").parent)
    with subprocess.Popen(
        [sys.executable, str(script), folder, module],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env=os.environ | {"PYTHONPATH": str(ROOT), "TMPDIR": str(tmp_path)},
    ) as server:
        assert server.stdout is not None
        exits = [os.pidfd_open(int(pid)) for pid in server.stdout.readline().split()]
        server.kill()
        server.wait(WAIT_S)
        gone = [select.select([fd], [], [], WAIT_S)[0] == [fd] for fd in exits]
    for fd in exits:
        os.close(fd)
    assert gone == [True] * (2 + SPARES)


def test_threads_run_a_task_here_while_another_one_goes_on(
    make: Callable[..., Executor], tmp_path: Path
) -> None:
    """Even where all workers are busy: the task waits for what is done meanwhile."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    executor, threads = make("threads"), list[int]()

    def meanwhile() -> None:
        threads.append(threading.get_ident())
        pipe.write_text("done")

    outcome = executor.run(
        "exec_wait_for_file", encode([str(pipe)]).frames, {}, lambda: True, meanwhile=meanwhile
    )
    assert outcome is not None
    assert value(outcome) == "done"
    assert threads != [threading.get_ident()]


def test_worker_processes_run_no_task_here(make: Callable[..., Executor]) -> None:
    """And then nothing is done meanwhile."""
    done = list[int]()
    executor = make("processes")
    assert (
        executor.run("exec_exit", encode([]).frames, {}, lambda: True, meanwhile=lambda: done.append(1))
        is None
    )
    assert done == []


def test_done_is_called_once_for_every_task(executor: Executor) -> None:
    """With the future that `submit` returned."""
    done: SimpleQueue[Future[Outcome]] = SimpleQueue()
    returned = executor.submit("exec_echo", encode(["text"]).frames, {}, done=done.put)
    assert done.get(timeout=WAIT_S) is returned
    assert value(returned.result(WAIT_S)) == "text"
    assert done.empty()
