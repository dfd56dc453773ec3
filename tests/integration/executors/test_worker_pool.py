"""Worker processes: their blob files, their CPU time, and how they start and end."""

import hashlib
import importlib
import os
import select
import signal
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import wait
from pathlib import Path
from queue import SimpleQueue

import numpy as np
import pytest

from offboard.cloud_server.executors import EXECUTORS, Executor
from offboard.cloud_server.executors.worker_pool import SPARES, WorkerPool
from tests.executor_tasks import ROOT, WAIT_S, call, run, value

pytestmark = pytest.mark.integration

BURNT_S = 0.2


def test_used_cpu_time_includes_dead_workers(make: Callable[..., Executor]) -> None:
    """If it did not, the load of other programs would seem higher for a moment."""
    changes: SimpleQueue[str] = SimpleQueue()
    executor = make("processes", changed=changes.put)
    run(executor, "exec_burn", BURNT_S)
    worker, *_ = value(run(executor, "exec_where", 0))
    used_s = executor.used_s()
    os.kill(worker, signal.SIGKILL)
    while changes.get(timeout=WAIT_S) != "signal":
        pass
    assert executor.used_s() >= used_s


def test_blob_files_are_private_and_bounded(make: Callable[..., Executor]) -> None:
    """Only the owner may read them, they stay within the limit, and `close` deletes them."""
    executor = make("processes", blob_bytes_max=2_000_000)
    assert isinstance(executor, WorkerPool)
    folder = executor.blob_folder
    assert folder.stat().st_mode & 0o077 == 0
    arrays = [np.full(100_000, n, float) for n in range(4)]
    for array in [*arrays, arrays[-1]]:
        assert value(run(executor, "exec_sum", array)) == array.sum()
        assert sum(file.stat().st_size for file in folder.iterdir()) <= 2_000_000
    kept = {file.name for file in folder.iterdir()}
    assert kept == {hashlib.sha256(array.tobytes()).hexdigest() for array in arrays[-2:]}
    executor.close()
    assert not folder.exists()


def test_a_blob_that_cannot_be_written_is_busy(make: Callable[..., Executor]) -> None:
    """The task does not run, and the next one does."""
    executor = make("processes")
    assert isinstance(executor, WorkerPool)
    folder, aside = executor.blob_folder, executor.blob_folder.with_suffix(".aside")
    folder.rename(aside)
    assert run(executor, "exec_sum", np.ones(100_000)).status == "busy"
    aside.rename(folder)
    assert value(run(executor, "exec_sum", np.ones(100_000))) == 100_000


def test_closing_does_not_wait_for_a_hanging_task(make: Callable[..., Executor], tmp_path: Path) -> None:
    """The task is abandoned, and its worker process is gone when `close` returns."""
    executor = make("processes")
    pid = value(run(executor, "exec_where", 0))[0]
    pipe = tmp_path / "never"
    os.mkfifo(pipe)
    hanging = executor.submit(call("exec_wait_for_file", str(pipe)), lambda _: None)
    executor.close()
    executor.close()
    assert hanging.result(WAIT_S).status != "ok"
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_closing_while_workers_start_ends_them(module: str) -> None:
    """A server can be stopped before it is ready."""
    executor = EXECUTORS["processes"](2, [module], 1000)
    starting = executor.warm()
    executor.close()
    wait([starting], WAIT_S)
    assert starting.done()


def test_workers_that_cannot_start_are_reported(module: str) -> None:
    """If a module cannot be imported in the workers, `warm` fails at once with the reason."""
    executor = EXECUTORS["processes"](2, [module, "no_such_module"], 1000)
    with pytest.raises(Exception, match="worker processes did not start"):
        executor.warm().result(WAIT_S)
    executor.close()


SERVER = """
import sys
from offboard.cloud_server.executors.worker_pool import WorkerPool

if __name__ == "__main__":
    sys.path.insert(0, sys.argv[1])
    pool = WorkerPool(2, [sys.argv[2]], 1000)
    pool.warm().result(8)
    print(*pool.pids, flush=True)
    sys.stdin.read()
"""


def test_workers_die_with_the_server(module: str, tmp_path: Path) -> None:
    """After `kill -9` of the server no worker process is left."""
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
