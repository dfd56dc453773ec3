"""Where tasks run: threads of this process, or worker processes. Both speak `concurrent.futures`."""

import contextlib
import logging
import math
import resource
import tempfile
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Protocol

from offboard.cloud_server.outcome import Blobs, Outcome, run_task, warm_kinds
from offboard.cloud_server.worker_pool import Call, Died, Setup, Worker
from offboard.common.errors import CloudBroken
from offboard.common.host.cpu_time import process_s
from offboard.common.threads import join_all
from offboard.common.wanted import always
from offboard.common.wire.blobs import Buffer

__all__ = ["EXECUTORS", "Executor", "Outcome", "Processes", "Threads"]

MEMORY_BYTES_MAX = 2 << 30  # of one worker process
CLOSE_WAIT_S = 1.0  # for threads whose tasks are abandoned
SPARES = 1  # worker processes beyond those that run tasks: a start takes longer than a crash may cost

Done = Callable[["Future[Outcome]"], None]

log = logging.getLogger("offboard.cloud_server")


class Executor(Protocol):
    """Runs tasks. `submit` and `run` are called in any thread; all else by the one that made it."""

    workers: int

    @property
    def up(self) -> int:
        """The workers that run a task or can take one; the others are being started again."""

    def warm(self, changed: Callable[[str], None] = lambda _: None) -> "Future[None]":
        """Start all workers and run each kind's warm in each. Once, and does not block.

        From then on `changed` is called, in any thread, with a word for why a worker died, and with none
        when one is up again.
        """

    def submit(
        self,
        kind: str,
        frames: Sequence[Buffer],
        blobs: Blobs,
        wanted: Callable[[], bool] = always,
        budget_s: float = math.inf,
        done: Done = lambda _: None,
    ) -> "Future[Outcome]":
        """Run a task now; called only while fewer than `up` run. The future never holds an exception.

        A task that looks may end early once it is not `wanted`. A worker process is killed when its task
        is still not done a little after its budget. `done` is the future's callback, and there before a
        worker can have ended the task: in its thread, or in this one where no worker can take it.
        """

    def run(
        self,
        kind: str,
        frames: Sequence[Buffer],
        blobs: Blobs,
        wanted: Callable[[], bool],
        *,
        meanwhile: Callable[[], None],
    ) -> Outcome | None:
        """Run a task in this thread while another one does `meanwhile`; None: tasks do not run here."""

    def used_s(self) -> float:
        """CPU seconds of the server and its workers so far. Any thread."""

    def close(self) -> None:
        """Stop; tasks still running are abandoned. Safe to call twice."""


class Threads:
    """Tasks in threads of the server: no copies, for tasks that release the interpreter lock.

    A task that crashes or never ends takes the server, or one of its threads, with it.
    """

    def __init__(self, workers: int) -> None:
        self.workers = self.up = workers
        self._calls: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self._threads = [
            threading.Thread(target=self._work, name=f"task-{n}", daemon=True)
            for n in range(workers + 1)  # one may do what is to be done meanwhile
        ]
        for thread in self._threads:
            thread.start()

    def warm(self, changed: Callable[[str], None] = lambda _: None) -> "Future[None]":  # noqa: ARG002
        warmed: Future[None] = Future()
        self._calls.put(partial(_warm, warmed))
        return warmed

    def submit(
        self,
        kind: str,
        frames: Sequence[Buffer],
        blobs: Blobs,
        wanted: Callable[[], bool] = always,
        budget_s: float = math.inf,  # noqa: ARG002 - a thread cannot be killed
        done: Done = lambda _: None,
    ) -> "Future[Outcome]":
        outcome: Future[Outcome] = Future()
        outcome.add_done_callback(done)
        self._calls.put(lambda: outcome.set_result(run_task(kind, frames, blobs, wanted)))
        return outcome

    def run(
        self,
        kind: str,
        frames: Sequence[Buffer],
        blobs: Blobs,
        wanted: Callable[[], bool],
        *,
        meanwhile: Callable[[], None],
    ) -> Outcome | None:
        self._calls.put(meanwhile)
        return run_task(kind, frames, blobs, wanted)

    def used_s(self) -> float:
        return time.process_time()

    def close(self) -> None:
        with contextlib.suppress(Empty):
            while True:
                self._calls.get_nowait()
        for _ in self._threads:
            self._calls.put(None)
        join_all(self._threads, CLOSE_WAIT_S)

    def _work(self) -> None:
        while (call := self._calls.get()) is not None:
            call()


def _warm(warmed: "Future[None]") -> None:
    try:
        warm_kinds()
    except BaseException as error:  # noqa: BLE001 - a task's own code
        warmed.set_exception(error)
    else:
        warmed.set_result(None)


class Processes:
    """Tasks in worker processes: for tasks that hold the interpreter lock, or may crash.

    A worker that dies takes its own task with it; a spare one takes its place, and becomes one when it is
    started again. Blobs reach the workers as files in a
    private directory, written once; each worker keeps what it read.
    """

    def __init__(
        self,
        workers: int,
        modules: Sequence[str],
        blob_bytes_max: int,
        memory_bytes_max: int = MEMORY_BYTES_MAX,
    ) -> None:
        self.workers = workers
        self._spool = _Spool(blob_bytes_max)
        self._setup = Setup(tuple(modules), str(self._spool.folder), blob_bytes_max, memory_bytes_max)
        self._changed: Callable[[str], None] = lambda _: None
        self._started: Future[None] = Future()
        self._workers: list[Worker] = []
        self._lock = threading.Lock()  # for what follows: the workers' threads change it
        self._up: set[Worker] = set()
        self._idle: list[Worker] = []

    @property
    def up(self) -> int:
        return min(len(self._up), self.workers)

    def warm(self, changed: Callable[[str], None] = lambda _: None) -> "Future[None]":
        assert not self._workers, "warm is called once"
        self._changed = changed
        self._workers = [Worker(self._setup, self._free, self._died) for _ in range(self.workers + SPARES)]
        return self._started

    def submit(
        self,
        kind: str,
        frames: Sequence[Buffer],
        blobs: Blobs,
        wanted: Callable[[], bool] = always,
        budget_s: float = math.inf,
        done: Done = lambda _: None,
    ) -> "Future[Outcome]":
        call = Call(kind, frames, tuple(blobs), wanted, budget_s)
        call.answer.add_done_callback(lambda _: self._spool.unpin(blobs))
        call.answer.add_done_callback(done)
        try:
            self._spool.pin(blobs)
        except OSError as error:
            call.answer.set_result(Outcome("busy", f"no room for the blobs: {error}"))
            return call.answer
        with self._lock:
            if self._idle:
                self._idle.pop().give(call)  # the last that ran: its caches are warm
                return call.answer
        call.answer.set_result(Outcome("busy", "a worker died, and the next one is not there yet"))
        return call.answer

    def run(self, *_: object, meanwhile: Callable[[], None]) -> None:  # noqa: ARG002
        return None

    def used_s(self) -> float:
        ended = resource.getrusage(resource.RUSAGE_CHILDREN)
        alive_s = sum(process_s(worker.pid) for worker in self._workers if worker.pid)
        return time.process_time() + ended.ru_utime + ended.ru_stime + alive_s

    def close(self) -> None:
        workers, self._workers = self._workers, []
        for worker in workers:
            worker.stop()
        for worker in workers:
            worker.join()
        self._spool.close()

    def _free(self, worker: Worker) -> None:
        with self._lock:
            self._idle.append(worker)
            known = worker in self._up
            self._up.add(worker)
            if len(self._up) == self.workers + SPARES and not self._started.done():
                self._started.set_result(None)
        if not known:
            self._changed("")

    def _died(self, worker: Worker, death: Died) -> None:
        with self._lock:
            self._up.discard(worker)
            if worker in self._idle:
                self._idle.remove(worker)
            if not self._started.done():
                self._started.set_exception(CloudBroken(f"worker processes did not start: one {death}"))
                return
        if death.reason != "closed":
            log.warning("worker %d %s; another one takes its place", worker.pid, death)
            self._changed(death.reason)


EXECUTORS: dict[str, Callable[..., Executor]] = {
    "threads": lambda workers, *_: Threads(workers),
    "processes": Processes,
}


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
