"""Where tasks run: threads of this process, or worker processes. Both speak `concurrent.futures`."""

import contextlib
import ctypes
import os
import signal
import tempfile
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import CancelledError, Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Protocol

from common import cpu, tasks
from common.blobs import BlobStore, Buffer, StoredBlob
from common.errors import CloudBroken, ProtocolError, describe
from common.values import decode, encode
from common.wanted import always, call_while

START_S_MAX = 300.0  # the slowest worker's start, compilation included
PR_SET_PDEATHSIG = 1

Blobs = Mapping[bytes, StoredBlob]


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a task went: ok, failed, or busy where it could not start; `run_s` is the time in the worker.

    `cpu_s` is the CPU time used meanwhile, by all that shares the quota, or else by the process that ran it.
    `server_fault`: it failed, but not by its own doing.
    """

    status: str
    error: str = ""
    run_s: float = 0.0
    cpu_s: float | None = None
    frames: list[Buffer] = field(default_factory=list)
    server_fault: bool = False


class Executor(Protocol):
    """Runs tasks. Every method is called from the one thread that made the executor."""

    workers: int

    @property
    def broken(self) -> bool:
        """Workers died; `submit` must not be called until `warm` is called again and done."""

    def warm(self) -> "Future[None]":
        """Start all workers and run each kind's warm in each. Does not block."""

    def submit(
        self, kind: str, frames: Sequence[Buffer], blobs: Blobs, wanted: Callable[[], bool] = always
    ) -> "Future[Outcome]":
        """Run a task now; called only while fewer than `workers` run. The future never holds an exception.

        A task that looks may end early once it is not `wanted`, where it runs in this process.
        """

    def close(self) -> None:
        """Stop; tasks still running are abandoned. Safe to call twice."""


class Threads:
    """Tasks in threads of the server: no copies, for tasks that release the interpreter lock."""

    broken = False

    def __init__(self, workers: int) -> None:
        self.workers = workers
        self._pool = ThreadPoolExecutor(workers, thread_name_prefix="task")

    def warm(self) -> "Future[None]":
        return self._pool.submit(_warm_kinds)

    def submit(
        self, kind: str, frames: Sequence[Buffer], blobs: Blobs, wanted: Callable[[], bool] = always
    ) -> "Future[Outcome]":
        return self._pool.submit(run_task, kind, frames, blobs, wanted)

    def close(self) -> None:
        self._pool.shutdown(wait=False, cancel_futures=True)


class Processes:
    """Tasks in worker processes: for tasks that hold the interpreter lock, or may crash.

    Blobs reach the workers as files in a private directory, written once; each worker keeps what it read.
    """

    def __init__(self, workers: int, modules: Sequence[str], blob_bytes_max: int) -> None:
        self.workers = workers
        self.broken = False
        self._modules = tuple(modules)
        self._spool = _Spool(blob_bytes_max)
        self._pool: ProcessPoolExecutor | None = None
        self._pids: list[int] = []
        self._running: set[Future[Any]] = set()

    def warm(self) -> "Future[None]":
        # Workers die with the thread that starts them (PDEATHSIG), hence the rule of one thread above.
        if self._pool is not None:
            self._pool.shutdown(wait=False)
        context = get_context("spawn")
        start = (self._modules, str(self._spool.folder), self._spool.bytes_max, os.getpid())
        self._barrier = context.Barrier(self.workers)  # no worker takes two of the calls below
        self._pool = ProcessPoolExecutor(self.workers, context, _start_worker, (*start, self._barrier))
        self.broken = False
        self._pids.clear()
        try:
            met = [self._pool.submit(_meet) for _ in range(self.workers)]
        except BrokenProcessPool as error:
            return _failed(error)
        return _all_started(met, self._pids)

    def submit(
        self,
        kind: str,
        frames: Sequence[Buffer],
        blobs: Blobs,
        wanted: Callable[[], bool] = always,  # noqa: ARG002 - a worker is not told
    ) -> "Future[Outcome]":
        answer: Future[Outcome] = Future()
        assert self._pool is not None, "submit before warm"
        try:
            self._spool.pin(blobs)
            running = self._pool.submit(_run_in_worker, kind, [bytes(f) for f in frames], list(blobs))
        except (BrokenProcessPool, OSError) as error:  # a worker died idle; no room for the blob
            self.broken = isinstance(error, BrokenProcessPool)
            self._spool.unpin(blobs)
            answer.set_result(Outcome("busy", f"no worker can take it: {error}"))
            return answer
        self._running.add(running)
        running.add_done_callback(lambda done: self._done(done, answer, blobs))
        return answer

    def close(self) -> None:
        if self._pool is not None:
            if len(self._pids) < self.workers:
                self._barrier.abort()  # still starting
            elif self._running:
                for pid in self._pids:
                    with contextlib.suppress(ProcessLookupError):
                        os.kill(pid, signal.SIGKILL)
            self._pool.shutdown(wait=True, cancel_futures=True)
            self._pool = None
        self._spool.close()

    def _done(self, running: "Future[Outcome]", answer: "Future[Outcome]", blobs: Blobs) -> None:
        self._running.discard(running)
        self._spool.unpin(blobs)
        if running.cancelled():
            answer.set_result(Outcome("busy", "the executor was closed before the task ran"))
            return
        error = running.exception()
        if error is None:
            answer.set_result(running.result())
        elif isinstance(error, BrokenProcessPool):
            self.broken = True
            answer.set_result(
                Outcome("failed", "a worker process died while this task ran", server_fault=True)
            )
        else:
            answer.set_result(Outcome("failed", describe(error), server_fault=True))


EXECUTORS: dict[str, Callable[[int, Sequence[str], int], Executor]] = {
    "threads": lambda workers, modules, blob_bytes_max: Threads(workers),  # noqa: ARG005
    "processes": Processes,
}


def run_task(
    kind_name: str, frames: Sequence[Buffer], blobs: Blobs, wanted: Callable[[], bool] = always
) -> Outcome:
    """Decode the arguments, call the task, encode its result; whatever it raises becomes the outcome."""
    cpu_before_s, started = cpu.used_s(), time.perf_counter()
    status, failure = "ok", ""
    result: list[Buffer] = []
    try:
        kind = tasks.kind_named(kind_name)
        args = decode(frames, kind.types, blobs)
        if not isinstance(args, list):
            raise ProtocolError("the body is not a list of arguments")
        result = encode(call_while(wanted, kind.function, args), kind.types).frames
    except BaseException as error:  # noqa: BLE001 - a task may raise anything
        status, failure = "failed", describe(error)
    run_s = time.perf_counter() - started
    return Outcome(status, failure, run_s, cpu.used_s() - cpu_before_s, result)


class _Spool:
    """Blobs as files, least recently used out first beyond `bytes_max`, pinned while a worker may read."""

    def __init__(self, bytes_max: int) -> None:
        self._directory = tempfile.TemporaryDirectory(prefix="offboard-blobs-", ignore_cleanup_errors=True)
        self.folder = Path(self._directory.name)
        self.bytes_max = bytes_max
        self._sizes: OrderedDict[bytes, int] = OrderedDict()
        self._pins: dict[bytes, int] = {}
        self._lock = threading.Lock()  # unpin is called from the pool's thread

    def pin(self, blobs: Blobs) -> None:
        with self._lock:
            for digest in blobs:
                self._pins[digest] = self._pins.get(digest, 0) + 1
            for digest, blob in blobs.items():
                if digest not in self._sizes:
                    (self.folder / digest.hex()).write_bytes(blob.data)
                    self._sizes[digest] = blob.data.nbytes
                self._sizes.move_to_end(digest)
            self._trim()

    def unpin(self, blobs: Blobs) -> None:
        with self._lock:
            for digest in blobs:
                self._pins[digest] -= 1
                if not self._pins[digest]:
                    del self._pins[digest]

    def close(self) -> None:
        self._directory.cleanup()

    def _trim(self) -> None:
        for digest in [d for d in self._sizes if d not in self._pins]:
            if sum(self._sizes.values()) <= self.bytes_max:
                return
            del self._sizes[digest]
            (self.folder / digest.hex()).unlink()


@dataclass(frozen=True, slots=True)
class _Worker:
    """State of one worker process."""

    folder: Path
    store: BlobStore
    barrier: Any

    def blob(self, digest: bytes) -> StoredBlob:
        blob = self.store.get(digest)
        if blob is None:
            self.store.add((self.folder / digest.hex()).read_bytes())
            blob = self.store.get(digest)
        assert blob is not None, "a blob larger than the store passed the server"
        return blob


_worker: _Worker | None = None


def _start_worker(modules: Sequence[str], folder: str, bytes_max: int, parent: int, barrier: Any) -> None:
    global _worker
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the group; the server drains
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)  # the parent died before the line above
    _worker = _Worker(Path(folder), BlobStore(bytes_max), barrier)
    tasks.load_modules(modules)
    _warm_kinds()


def _meet() -> int:
    """Wait until every worker is here, so that each has started; its process id."""
    assert _worker is not None
    _worker.barrier.wait(START_S_MAX)
    return os.getpid()


def _run_in_worker(kind: str, frames: list[bytes], digests: list[bytes]) -> Outcome:
    assert _worker is not None
    outcome = run_task(kind, frames, {digest: _worker.blob(digest) for digest in digests})
    return replace(outcome, frames=[bytes(f) for f in outcome.frames])


def _warm_kinds() -> None:
    cpu.used_s()  # the first call looks for what to read
    for kind in tasks.kinds():
        if kind.warm is not None:
            kind.warm()


def _all_started(met: "list[Future[int]]", pids: list[int]) -> "Future[None]":
    """Done when every worker met the others; `pids` is filled."""
    started: Future[None] = Future()
    left = threading.Semaphore(len(met) - 1)

    def one_met(future: "Future[int]") -> None:
        # Cancelled: the executor was closed before this worker came to it.
        error = CancelledError("closed") if future.cancelled() else future.exception()
        if error is None:
            pids.append(future.result())
        if left.acquire(blocking=False):
            return
        if len(pids) == len(met):
            started.set_result(None)
        else:
            started.set_exception(CloudBroken(f"worker processes did not start: {error}"))

    for future in met:
        future.add_done_callback(one_met)
    return started


def _failed(error: Exception) -> "Future[None]":
    future: Future[None] = Future()
    future.set_exception(CloudBroken(f"worker processes did not start: {error}"))
    return future
