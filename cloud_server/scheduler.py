"""Decides what happens to each request: accept or refuse it, when it starts, and how it is answered.

Every method but `wanted` is called under the lock of the channel.
"""

import logging
import time
from collections import Counter, OrderedDict
from dataclasses import dataclass

from offboard.cloud_server.authorisation import Access
from offboard.cloud_server.executors.executor import Executor, Outcome, bounded
from offboard.cloud_server.fair_queue import FairQueue, Work
from offboard.cloud_server.metrics import Metrics
from offboard.cloud_server.robot_socket import ReplySender
from offboard.common import tasks
from offboard.common.load import LoadWatch
from offboard.common.wire.blobs import BlobStore
from offboard.common.wire.messages import Reply, Request

CRASHES_MAX = 3  # workers that one request may cost
CRASHED_KEPT = 1024  # requests whose crashes are remembered
FAILURES_KEPT = 256  # kinds and types of errors that are logged: a task may make types without limit

log = logging.getLogger("offboard.cloud_server")


@dataclass(frozen=True, slots=True)
class Refusal:
    """The answer to a request that does not run. `queue_s` is the time that it has waited, if it has."""

    status: str
    error: str = ""
    queue_s: float = 0.0
    missing: tuple[bytes, ...] = ()


class Scheduler:
    """The requests of all robots, from their arrival to their answer.

    The server sets `warm` once all workers are warm, and `draining` when it stops.
    """

    def __init__(
        self,
        executor: Executor,
        sender: ReplySender,
        metrics: Metrics,
        *,
        blobs: BlobStore,
        queue_max: int,
        message_bytes_max: int,
        access: Access,
        load: LoadWatch,
    ) -> None:
        self.warm = False
        self.draining = False
        self.last_task: float | None = None  # time of the last answer
        self._executor = executor
        self._sender = sender
        self._metrics = metrics
        self._blobs = blobs
        self._message_bytes_max = message_bytes_max
        self._access = access
        self._load = load
        self._queue = FairQueue(queue_max)
        self._crashes = CrashCount()
        self._failures = FailureLog()
        self._running: set[Work] = set()
        self._chosen: list[Work] = []  # counts as running; the thread that chose it starts it

    @property
    def ready(self) -> bool:
        """True once all workers were warm, as long as one of them is up."""
        return self.warm and self._executor.up > 0

    @property
    def waiting(self) -> int:
        return len(self._queue)

    @property
    def running(self) -> int:
        return len(self._running)

    def waiting_by_robot(self) -> Counter[bytes]:
        return Counter(work.robot for work in self._queue)

    def request(self, peer: bytes, request: Request) -> None:
        """Put a request into the queue, or answer why not."""
        work = Work(peer, request, {}, time.monotonic(), robot=self._access.robot_of(peer))
        refusal = self._refusal(work)
        if refusal is not None:
            self.refuse(peer, request, refusal)
            return
        evicted = self._queue.add(work)
        if evicted is not None:
            self.refuse(evicted.peer, evicted.request, self._full())
        self._choose()

    def _refusal(self, work: Work) -> Refusal | None:
        """Why this request cannot be accepted; None if it can, and then it has its blobs."""
        request = work.request
        if not tasks.is_kind(request.kind):
            return Refusal("unknown_task", f"no task named {request.kind!r} on this server")
        if self._crashes.too_many(work.peer, request.id):
            return Refusal("failed", f"its worker died {CRASHES_MAX} times; it is not run again")
        if self.draining:
            return Refusal("busy", "the server is stopping")
        if not self.ready:
            return Refusal("busy", "the server is warming up")
        if self._queue.closed_to(work.robot):
            return self._full()
        for digest in request.blobs:
            if (blob := self._blobs.get(digest)) is not None:
                work.blobs[digest] = blob
        if missing := tuple(digest for digest in request.blobs if digest not in work.blobs):
            return Refusal("need_blob", missing=missing)
        if self._queue.bytes_with(work) > self._blobs.bytes_max + self._message_bytes_max:
            return Refusal("busy", "waiting requests hold all the memory allowed")
        return None

    def _full(self) -> Refusal:
        return Refusal("busy", f"{len(self._queue)} requests are waiting")

    def cancel(self, peer: bytes, id: int | None = None) -> None:
        """Nobody wants the answer to this request (None: to any request of this connection) any more."""

        def cancelled(work: Work) -> bool:
            return work.peer == peer and id in (None, work.request.id)

        for work in self._queue.take(cancelled):
            self._count(work.request, "cancelled")
        for work in filter(cancelled, self._running):
            work.wanted = False

    def peers(self) -> set[bytes]:
        """The connections that wait for answers."""
        return {work.peer for work in (*self._queue, *self._running) if work.wanted}

    def expire(self, now: float) -> None:
        """Answer the waiting requests whose budget is over."""
        for work in self._queue.take(lambda work: work.expired(now)):
            self.refuse(work.peer, work.request, Refusal("expired", queue_s=now - work.arrived))

    def take_chosen(self) -> list[Work]:
        """The work to start now, in the calling thread."""
        self._choose()
        chosen, self._chosen = self._chosen, []
        return chosen

    def _choose(self) -> None:
        """Move waiting requests to the free workers. From then on they count as running."""
        while self.ready and len(self._running) < self._executor.up:
            work = self._queue.next()
            if work is None:
                return
            now = time.monotonic()
            work.queue_s = now - work.arrived
            if not self._access.knows(work.peer):
                self._queue.done(work, 0.0)
                self._count(work.request, "cancelled")
                continue
            if work.expired(now):
                self._queue.done(work, 0.0)
                self.refuse(work.peer, work.request, Refusal("expired", queue_s=work.queue_s))
                continue
            self._running.add(work)
            self._chosen.append(work)

    def wanted(self, work: Work) -> bool:
        """False if this run should stop: its answer is not wanted, or its robot may not have it.

        A run that must not be repeated goes on, within its budget. Called in any thread.
        """
        goes_on = work.wanted or (
            not tasks.kind_named(work.request.kind).duplicate and not work.expired(time.monotonic())
        )
        return goes_on and self._access.knows(work.peer)

    def answer(self, work: Work, outcome: Outcome) -> None:
        """A task has ended: send its reply."""
        self._running.discard(work)
        self._queue.done(work, outcome.run_s)
        self.last_task = time.monotonic()
        request = work.request
        if outcome.crashed:
            self._crashes.note(work.peer, request.id)
        outcome = bounded(outcome, self._message_bytes_max)
        self._failures.note(request.kind, outcome)
        if work.wanted:
            self._load.hurry()  # the load during the task, not before it
            load, capacity = outcome.load or self._load.latest()
            reply = Reply(
                request.id, outcome.status, outcome.error, work.queue_s,
                run_s=outcome.run_s, queue_depth=len(self._queue), server_fault=outcome.server_fault,
                body=outcome.frames, cpu_s=outcome.cpu_s, load=load, capacity=capacity,
                traceback=outcome.traceback,
            )  # fmt: skip
            self._sender.send(work.peer, reply)
        self._count(request, outcome.status if work.wanted else "cancelled", work.queue_s, outcome.run_s)
        self._metrics.queue_s_of(request.kind).observe(work.queue_s)
        self._metrics.run_s_of(request.kind).observe(outcome.run_s)
        if self._metrics.robots.counting:
            use = self._metrics.robots.of(work.robot)
            use.tasks += 1
            use.queue_s += work.queue_s
            use.run_s += outcome.run_s

    def give_up(self) -> int:
        """Answer the waiting requests with `busy`; returns how many requests were waiting or running.

        Running requests get no answer, because `busy` would mean that they never ran. Their robots notice
        that the connection is closed.
        """
        waiting = self._queue.take(lambda _: True)
        for work in waiting:
            self.refuse(work.peer, work.request, Refusal("busy", "the server stopped"))
        return len(waiting) + len(self._running)

    def refuse(self, peer: bytes, request: Request, why: Refusal) -> None:
        self._count(request, why.status, why.queue_s)
        if self._metrics.robots.counting and why.status != "need_blob":  # the robot sends that one again
            self._metrics.robots.of(self._access.robot_of(peer)).refused += 1
        reply = Reply(
            request.id, why.status, why.error,
            queue_s=why.queue_s, queue_depth=len(self._queue), missing=why.missing,
        )  # fmt: skip
        self._sender.send(peer, reply)

    def _count(self, request: Request, status: str, queue_s: float = 0.0, run_s: float = 0.0) -> None:
        # A robot can send any name. A label for each of them would take memory without limit.
        kind = "unknown" if status == "unknown_task" else request.kind
        self._metrics.requests_of(kind, status).inc()
        if log.isEnabledFor(logging.DEBUG):
            text = "task %d of kind %s: %s after %.6f s of waiting and %.6f s of running"
            fields = {"id": request.id, "kind": kind, "status": status, "queue_s": queue_s, "run_s": run_s}
            log.debug(text, request.id, kind, status, queue_s, run_s, extra={"task": fields})


class CrashCount:
    """How many workers each request has cost, for the last CRASHED_KEPT requests that cost one."""

    def __init__(self) -> None:
        self._counts: OrderedDict[tuple[bytes, int], int] = OrderedDict()

    def note(self, peer: bytes, id: int) -> None:
        self._counts[peer, id] = self._counts.pop((peer, id), 0) + 1
        if len(self._counts) > CRASHED_KEPT:
            self._counts.popitem(last=False)

    def too_many(self, peer: bytes, id: int) -> bool:
        return self._counts.get((peer, id), 0) >= CRASHES_MAX


class FailureLog:
    """Logs the traceback of a failing task, once for each kind and type of error."""

    def __init__(self) -> None:
        self._logged: set[tuple[str, str]] = set()

    def note(self, kind: str, outcome: Outcome) -> None:
        failure = kind, outcome.error.partition(":")[0]
        if not outcome.traceback or failure in self._logged or len(self._logged) == FAILURES_KEPT:
            return
        self._logged.add(failure)
        log.warning(
            "task %s failed; its next failures with %s are not logged; remedy: correct the task\n%s",
            *failure,
            outcome.traceback.rstrip(),
        )
