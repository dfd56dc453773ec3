"""The executor that runs tasks in worker processes, and the files through which they get blobs.

`worker` keeps one process alive; `worker_process` is what runs in it.
"""

import logging
import resource
import tempfile
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from pathlib import Path

from offboard.cloud_server.executors.executor import THIS_COMPUTER
from offboard.cloud_server.executors.task_run import Blobs, Call, Outcome
from offboard.cloud_server.executors.worker import Assignment, Died, Worker
from offboard.cloud_server.executors.worker_process import Setup
from offboard.common.errors import CloudBroken, TaskFailed
from offboard.common.host.cpu_time import process_s

MEMORY_BYTES_MAX = 2 << 30  # of one worker process
SPARES = 1  # worker processes kept ready: starting one takes longer than a crash may cost

log = logging.getLogger("offboard.cloud_server")


class WorkerPool:
    """Runs tasks in processes: for tasks that hold the interpreter lock, or that may crash.

    A worker that dies takes only its own task with it. A spare worker takes its place, and the dead one is
    started again as the next spare. Blobs reach the workers as files in a private folder: each is written
    once, and each worker keeps those that it has read.

    Parameters: `workers` tasks run at the same time; `modules` register the tasks; `blob_bytes_max` limits
    the files; `memory_bytes_max` limits each worker process.
    """

    name = "processes"

    def __init__(
        self,
        workers: int,
        modules: Sequence[str],
        blob_bytes_max: int,
        memory_bytes_max: int = MEMORY_BYTES_MAX,
    ) -> None:
        self.workers = workers
        self._files = _BlobFiles(blob_bytes_max)
        self._setup = Setup(tuple(modules), str(self._files.folder), blob_bytes_max, memory_bytes_max)
        self._changed: Callable[[str], None] = lambda _: None
        self._started: Future[None] = Future()
        self._workers: list[Worker] = []
        self._lock = threading.Lock()  # protects the next two, which the threads of the workers change
        self._up: set[Worker] = set()
        self._idle: list[Worker] = []

    @property
    def up(self) -> int:
        return min(len(self._up), self.workers)

    @property
    def blob_folder(self) -> Path:
        """Where the workers read blobs."""
        return self._files.folder

    @property
    def pids(self) -> list[int]:
        """The processes of all workers, spares included; 0 for a worker that has not started yet."""
        return [worker.pid for worker in self._workers]

    def warm(self, changed: Callable[[str], None] = lambda _: None) -> "Future[None]":
        assert not self._workers, "warm is called once"
        self._changed = changed
        self._workers = [Worker(self._setup, self._free, self._died) for _ in range(self.workers + SPARES)]
        return self._started

    def submit(self, call: Call, done: "Callable[[Future[Outcome]], None]") -> "Future[Outcome]":
        assignment = Assignment(call)
        assignment.answer.add_done_callback(lambda _: self._files.unpin(call.blobs))
        assignment.answer.add_done_callback(done)
        try:
            self._files.pin(call.blobs)
        except OSError as error:
            assignment.answer.set_result(Outcome("busy", f"the blobs cannot be written: {error}"))
            return assignment.answer
        with self._lock:
            if self._idle:
                self._idle.pop().give(assignment)  # the one that ran last: its caches are warm
                return assignment.answer
        assignment.answer.set_result(Outcome("busy", "a worker died, and the next one is not ready yet"))
        return assignment.answer

    def places(self) -> dict[str, int]:
        return {THIS_COMPUTER: self.up}

    def load(self) -> None:
        return None

    def run(self, call: Call, *, meanwhile: Callable[[], None] | None) -> None:  # noqa: ARG002
        return None

    def used_s(self) -> float:
        ended = resource.getrusage(resource.RUSAGE_CHILDREN)
        alive_s = sum(process_s(pid) for pid in self.pids if pid)
        return time.process_time() + ended.ru_utime + ended.ru_stime + alive_s

    def close(self) -> None:
        workers, self._workers = self._workers, []
        for worker in workers:
            worker.stop()
        for worker in workers:
            worker.join()
        self._files.close()

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
                text = f"worker processes did not start: one {death}"
                self._started.set_exception(death.failure or CloudBroken(text))
                return
        if death.reason != "closed":
            failure = death.failure
            frames = f"\n{failure.traceback.rstrip()}" if isinstance(failure, TaskFailed) else ""
            text = "worker %d %s; another worker takes its place; remedy: correct its task, or its limits%s"
            log.warning(text, worker.pid, death, frames)
            self._changed(death.reason)


class _BlobFiles:
    """Blobs as files in a private folder.

    Beyond `bytes_max` the least recently used are deleted, but none that a worker may still read.
    """

    def __init__(self, bytes_max: int) -> None:
        self._directory = tempfile.TemporaryDirectory(prefix="offboard-blobs-", ignore_cleanup_errors=True)
        self.folder = Path(self._directory.name)
        self._bytes_max = bytes_max
        self._sizes: OrderedDict[bytes, int] = OrderedDict()
        self._pins: dict[bytes, int] = {}
        self._lock = threading.Lock()  # `unpin` is called in the threads of the workers

    def pin(self, blobs: Blobs) -> None:
        """Write the blobs that are not there yet, and keep all of them until `unpin`."""
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
            if sum(self._sizes.values()) <= self._bytes_max:
                return
            del self._sizes[digest]
            (self.folder / digest.hex()).unlink()
