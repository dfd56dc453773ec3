"""The executor that runs tasks in worker processes; `worker` keeps one process alive."""

import logging
import resource
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from pathlib import Path

from offboard.cloud_server.executors.worker import Worker
from offboard.cloud_server.executors.worker_process import Setup
from offboard.cloud_server.executors.worker_set import Assignment, Died, PinnedBlobs, WorkerSet
from offboard.common.cpu_time import process_s
from offboard.common.errors import CloudBroken, OffloadError, TaskFailed
from offboard.common.wire.blobs import StoredBlob

MEMORY_BYTES_MAX = 2 << 30  # of one worker process
SPARES = 1  # worker processes kept ready: starting one takes longer than a crash may cost

log = logging.getLogger("offboard.cloud_server")


class WorkerPool(WorkerSet[Worker, None]):
    """Runs tasks in processes: for tasks that hold the interpreter lock, or that may crash.

    A spare worker takes the place of one that dies, and the dead one is started again as the next spare.
    Blobs reach the workers as files in a private folder, and each worker keeps those that it has read.

    Parameters: `workers` tasks run at the same time; `modules` register the tasks; `blob_bytes_max` limits
    the files; `memory_bytes_max` limits each worker process.
    """

    name = "processes"
    no_room = "the blobs cannot be written"

    def __init__(
        self,
        workers: int,
        modules: Sequence[str],
        blob_bytes_max: int,
        memory_bytes_max: int = MEMORY_BYTES_MAX,
    ) -> None:
        super().__init__(workers, PinnedBlobs(blob_bytes_max, self._write, self._delete))
        self._folder = tempfile.TemporaryDirectory(prefix="offboard-blobs-", ignore_cleanup_errors=True)
        self._setup = Setup(tuple(modules), self._folder.name, blob_bytes_max, memory_bytes_max)
        self._workers: list[Worker] = []

    @property
    def blob_folder(self) -> Path:
        return Path(self._folder.name)

    @property
    def pids(self) -> list[int]:
        """The processes of all workers, spares included; 0 for a worker that has not started yet."""
        return [worker.pid for worker in self._workers]

    def warm(self, changed: Callable[[str], None] = lambda _: None) -> "Future[None]":
        assert not self._workers, "warm is called once"
        self._changed = changed
        self._workers = [Worker(self._setup, self._free, self._died) for _ in range(self.workers + SPARES)]
        return self._started

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
        self._folder.cleanup()

    def _give(self, worker: Worker, assignment: Assignment, references: dict[bytes, None]) -> None:  # noqa: ARG002
        worker.give(assignment)

    def _came_up(self, worker: Worker) -> None:  # noqa: ARG002
        if len(self._up) == self.workers + SPARES and not self._started.done():
            self._started.set_result(None)

    def _start_failure(self, death: Died) -> OffloadError:
        return death.failure or CloudBroken(f"worker processes did not start: one {death}")

    def _log_death(self, worker: Worker, death: Died) -> None:
        failure = death.failure
        frames = f"\n{failure.traceback.rstrip()}" if isinstance(failure, TaskFailed) else ""
        text = "worker %d %s; another worker takes its place; remedy: correct its task, or its limits%s"
        log.warning(text, worker.pid, death, frames)

    def _write(self, digest: bytes, blob: StoredBlob) -> None:
        (self.blob_folder / digest.hex()).write_bytes(blob.data)

    def _delete(self, digest: bytes) -> None:
        (self.blob_folder / digest.hex()).unlink()
