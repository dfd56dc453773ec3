"""The executor that runs tasks on a Ray cluster; `ray_worker` keeps one actor alive."""

import contextlib
import logging
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from queue import Empty, SimpleQueue
from typing import Any

from offboard.cloud_server.executors.ray_actor import ActorSetup
from offboard.cloud_server.executors.ray_cluster import RayCluster
from offboard.cloud_server.executors.ray_worker import RayWorker
from offboard.cloud_server.executors.worker import LOOK_S, START_S_MAX
from offboard.cloud_server.executors.worker_set import Assignment, Died, PinnedBlobs, WorkerSet
from offboard.common.errors import CloudBroken, ConfigError, OffloadError

PLACE_S_MAX = 30.0  # until the server starts with fewer workers, if the nodes have no room for more
IDLE_LOOK_S = 0.1  # between two checks of the workers while no task runs
HEAD_EVERY_S = 1.0  # between two questions to the head
HEAD_SILENT_S_MAX = 5.0  # of the head, until no more tasks are taken
HEAD_LOST_S = 30.0  # of silence, until this server leaves the cluster and waits for a new head
CLOSE_S_MAX = 5.0  # until the thread that owns the workers has ended

log = logging.getLogger("offboard.cloud_server")


class RayExecutor(WorkerSet[RayWorker, Any]):
    """Runs tasks in actors on the nodes of a Ray cluster, one task each at a time.

    Another actor takes the place of one that dies. Blobs are put into the object store of Ray once, and leave
    it when `blob_bytes_max` is exceeded. Actors that find no room wait for a node to join. While the head is
    silent, no worker is up.
    """

    name = "ray"
    no_room = "the blobs do not fit into Ray"

    def __init__(self, cluster: RayCluster, workers: int, setup: ActorSetup, blob_bytes_max: int) -> None:
        super().__init__(
            workers, PinnedBlobs(blob_bytes_max, lambda _, blob: cluster.put(blob), lambda _: None)
        )
        self._cluster = cluster
        self._events: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._workers = [
            RayWorker(cluster, setup, post=self._events.put, free=self._free, died=self._died)
            for _ in range(workers)
        ]
        self._closing = threading.Event()
        self._head_at_s = self._looked_at_s = time.monotonic()
        self._headless = False
        self._session = 0  # one for each connection to a cluster
        self._thread = threading.Thread(target=self._tend, name="ray-workers", daemon=True)

    @property
    def up(self) -> int:
        return 0 if self._headless else super().up

    def places(self) -> dict[str, int]:
        with self._lock:
            return dict(Counter(worker.host for worker in self._up))

    def load(self) -> tuple[float, float] | None:
        with self._lock:
            loads = [worker.load for worker in self._up]
        if not loads:
            return None
        load, capacity = (sum(numbers) / len(loads) for numbers in zip(*loads, strict=True))
        return load, capacity

    def warm(self, changed: Callable[[str], None] = lambda _: None) -> "Future[None]":
        self._changed = changed
        self._head_at_s = self._looked_at_s = time.monotonic()
        self._watch_head()
        self._thread.start()
        return self._started

    def used_s(self) -> float:
        return time.process_time() + sum(worker.used_s for worker in self._workers)

    def close(self) -> None:
        self._closing.set()
        self._events.put(lambda: None)
        if self._thread.is_alive():
            self._thread.join(CLOSE_S_MAX)
        for worker in self._workers:
            worker.end()
            worker.abandon()
        self._blobs.clear()
        self._cluster.disconnect()

    def _tend(self) -> None:
        """The thread that owns the workers."""
        began_s = time.monotonic()
        while not self._closing.is_set():
            busy = any(worker.running for worker in self._workers)
            with contextlib.suppress(Empty):
                self._events.get(timeout=LOOK_S if busy else IDLE_LOOK_S)()
                while True:
                    self._events.get_nowait()()
            self._look(began_s)

    def _look(self, began_s: float) -> None:
        """Notice whether the head answers, tend each worker, and end the start of the server."""
        now_s = time.monotonic()
        paused_s = now_s - self._looked_at_s
        if paused_s > HEAD_SILENT_S_MAX:  # this process was paused, and asked the head nothing
            self._head_at_s = min(now_s, self._head_at_s + paused_s)
        silent_s = now_s - self._head_at_s
        if (silent_s > HEAD_SILENT_S_MAX) != self._headless:
            self._head_changed()
        if silent_s > HEAD_LOST_S:
            self._connect_again()
        for worker in self._workers:
            same = [one.pid for one in self._workers if one.pid and one.host == worker.host]
            worker.tend([pid for pid in same if pid != worker.pid])
        if not self._started.done():
            self._end_start(now_s - began_s)
        self._looked_at_s = time.monotonic()

    def _head_changed(self) -> None:
        self._headless = not self._headless
        if self._headless:
            text = "the head of the Ray cluster does not answer: no task is taken; remedy: start it again"
            log.error(text)
        else:
            log.info("the head of the Ray cluster answers again")
        self._changed("head" if self._headless else "")

    def _connect_again(self) -> None:
        """The head is lost, and with it the cluster: wait for a new one at the same address."""
        for worker in self._workers:
            worker.lose("head", "was lost with the head of the cluster")
        self._cluster.disconnect()
        while not self._closing.wait(HEAD_EVERY_S):
            self._blobs.clear()  # also those of a connection that failed half-way
            with contextlib.suppress(ConfigError):
                self._cluster.connect()
                break
        self._head_at_s = time.monotonic()
        self._watch_head()

    def _end_start(self, after_s: float) -> None:
        """All workers that the nodes have room for are up, or none came up."""
        if len(self._up) == self.workers:
            self._started.set_result(None)
        elif self._up and after_s > PLACE_S_MAX:
            text = "%d of %d workers fit on the Ray nodes; remedy: add nodes, or lower --workers"
            log.warning(text, len(self._up), self.workers)
            self._started.set_result(None)
        elif after_s > START_S_MAX:
            self._started.set_exception(
                CloudBroken(f"no worker was up on the Ray cluster within {START_S_MAX:g} s")
            )

    def _watch_head(self) -> None:
        self._session += 1
        watch = threading.Thread(target=self._ask_head, args=(self._session,), name="ray-head", daemon=True)
        watch.start()

    def _ask_head(self, session: int) -> None:
        """Ask in a thread of its own, because a question waits as long as the head is silent."""
        while session == self._session and not self._closing.wait(HEAD_EVERY_S):
            if self._cluster.answers() and session == self._session:
                self._head_at_s = time.monotonic()

    def _give(self, worker: RayWorker, assignment: Assignment, references: dict[bytes, Any]) -> None:
        worker.give(assignment, references, self._blobs.keeps)

    def _came_up(self, worker: RayWorker) -> None:
        log.info("worker %d on %s is up", worker.pid, worker.host)

    def _start_failure(self, death: Died) -> OffloadError | None:
        return death.failure

    def _log_death(self, worker: RayWorker, death: Died) -> None:
        text = "worker %d on %s %s; another one takes its place; remedy: look at its task, limits and node"
        log.warning(text, worker.pid, worker.host or "the Ray cluster", death)


def make(
    workers: int,
    modules: Sequence[str],
    blob_bytes_max: int,
    memory_bytes_max: int,
    *,
    ray_address: str,
    ray_resources: Mapping[str, float],
) -> RayExecutor:
    """Connect to the cluster at `ray_address`. ConfigError if no actor could ever start there."""
    cluster = RayCluster(ray_address, ray_resources)
    cluster.connect()
    try:
        cluster.check_resources()
    except ConfigError:
        cluster.disconnect()
        raise
    setup = ActorSetup(tuple(modules), tuple(sys.path), memory_bytes_max)
    return RayExecutor(cluster, workers, setup, blob_bytes_max)
