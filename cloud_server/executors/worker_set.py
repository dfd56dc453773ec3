"""What executors share whose workers may die: which workers are idle, and the blobs that they can read."""

import threading
from abc import abstractmethod
from collections import Counter, OrderedDict
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from offboard.cloud_server.executors.executor import Blobs, Call, Executor, Outcome
from offboard.common.errors import OffloadError
from offboard.common.wire.blobs import StoredBlob

W = TypeVar("W")
R = TypeVar("R")


@dataclass(frozen=True, slots=True, eq=False)
class Assignment:
    """A call for a worker, and the future of its answer, which never holds an exception."""

    call: Call
    answer: "Future[Outcome]" = field(default_factory=Future)


class Died(Exception):
    """A worker has ended, or must be ended.

    `reason` is one word. `outcome` is the outcome of its task, if the task ended before the worker did.
    `failure`: why the worker could not start, for example what a task raised when it was prepared.
    """

    def __init__(
        self,
        reason: str,
        text: str,
        *,
        server_fault: bool = False,
        outcome: Outcome | None = None,
        failure: OffloadError | None = None,
    ) -> None:
        super().__init__(text)
        self.reason = reason
        self.server_fault = server_fault
        self.outcome = outcome
        self.failure = failure


class WorkerSet(Executor, Generic[W, R]):
    """An executor that gives each task to an idle worker `W`, and knows its blobs by references `R`.

    A worker that dies takes only its own task with it.
    """

    no_room: str  # what a reply says if blobs cannot be put where workers read them

    def __init__(self, workers: int, blobs: "PinnedBlobs[R]") -> None:
        self.workers = workers
        self._blobs = blobs
        self._changed: Callable[[str], None] = lambda _: None
        self._started: Future[None] = Future()
        self._lock = threading.Lock()  # protects the next two
        self._up: set[W] = set()
        self._idle: list[W] = []

    @property
    def up(self) -> int:
        return min(len(self._up), self.workers)

    def submit(self, call: Call, done: "Callable[[Future[Outcome]], None]") -> "Future[Outcome]":
        assignment, blobs = Assignment(call), call.all_blobs if call.more else call.blobs
        assignment.answer.add_done_callback(lambda _: self._blobs.unpin(blobs))
        assignment.answer.add_done_callback(done)
        try:
            references = self._blobs.pin(blobs)
        except OSError as error:
            assignment.answer.set_result(Outcome("busy", f"{self.no_room}: {error}"))
            return assignment.answer
        with self._lock:
            if self._idle:
                self._give(self._idle.pop(), assignment, references)  # it ran last: its caches are warm
                return assignment.answer
        assignment.answer.set_result(Outcome("busy", "a worker died, and the next one is not ready yet"))
        return assignment.answer

    def _free(self, worker: W) -> None:
        """This worker can take a task, perhaps its first one."""
        with self._lock:
            self._idle.append(worker)
            known = worker in self._up
            self._up.add(worker)
            if not known:
                self._came_up(worker)
        if not known:
            self._changed("")

    def _died(self, worker: W, death: Died) -> None:
        with self._lock:
            self._up.discard(worker)
            if worker in self._idle:
                self._idle.remove(worker)
            failure = None if self._started.done() else self._start_failure(death)
            if failure is not None:
                self._started.set_exception(failure)
                return
        if death.reason != "closed":
            self._log_death(worker, death)
            self._changed(death.reason)

    @abstractmethod
    def _give(self, worker: W, assignment: Assignment, references: dict[bytes, R]) -> None: ...

    @abstractmethod
    def _came_up(self, worker: W) -> None: ...

    @abstractmethod
    def _start_failure(self, death: Died) -> OffloadError | None:
        """The error with which the server does not start; None if the next worker may do better."""

    @abstractmethod
    def _log_death(self, worker: W, death: Died) -> None: ...


class PinnedBlobs(Generic[R]):
    """Blobs where the workers can read them, each put there once. Any thread may call any method.

    Beyond `bytes_max` the least recently used are dropped, but none that a worker may still read. `put`
    returns the reference of a blob; OSError if there is no room.
    """

    def __init__(
        self, bytes_max: int, put: Callable[[bytes, StoredBlob], R], drop: Callable[[bytes], None]
    ) -> None:
        self._bytes_max = bytes_max
        self._put, self._drop = put, drop
        self._kept: OrderedDict[bytes, tuple[R, int]] = OrderedDict()  # with their sizes
        self._byte_count = 0
        self._pins: Counter[bytes] = Counter()
        self._lock = threading.Lock()

    def pin(self, blobs: Blobs) -> dict[bytes, R]:
        """The references of these blobs, which are kept until `unpin`."""
        with self._lock:
            self._pins.update(blobs.keys())
            for digest, blob in blobs.items():
                if digest not in self._kept:
                    self._kept[digest] = self._put(digest, blob), blob.data.nbytes
                    self._byte_count += blob.data.nbytes
                self._kept.move_to_end(digest)
            for digest in [one for one in self._kept if not self._pins[one]]:
                if self._byte_count <= self._bytes_max:
                    break
                self._byte_count -= self._kept.pop(digest)[1]
                self._drop(digest)
            return {digest: self._kept[digest][0] for digest in blobs}

    def unpin(self, blobs: Blobs) -> None:
        with self._lock:
            self._pins -= Counter(blobs.keys())

    def keeps(self, digest: bytes) -> bool:
        return digest in self._kept

    def clear(self) -> None:
        with self._lock:
            self._kept.clear()
            self._byte_count = 0
