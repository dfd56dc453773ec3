"""Decides what happens to each request: accept or refuse it, when it starts, and how it is answered.

Every method but `wanted` is called under the lock of the channel.
"""

import logging
import math
import time
from collections import Counter
from dataclasses import dataclass
from functools import partial

from offboard.cloud_server.authorisation import Access
from offboard.cloud_server.executors.executor import Executor, Outcome, bounded
from offboard.cloud_server.failures import CRASHES_MAX, CrashCount, FailureLog
from offboard.cloud_server.fair_queue import FairQueue, Work
from offboard.cloud_server.gathering import Gathering, Group
from offboard.cloud_server.metrics import Metrics
from offboard.cloud_server.robot_socket import ReplySender
from offboard.common import tasks
from offboard.common.load import LoadWatch
from offboard.common.wire.blobs import BlobStore
from offboard.common.wire.messages import Reply, Request, byte_count

TRIED_EVERY = 10  # requests that should come too late, of which one runs: the server may be faster by now
RUN_BYTES_MAX = 64 << 20  # of the requests that run together, without their blobs

log = logging.getLogger("offboard.cloud_server")


@dataclass(frozen=True, slots=True)
class Refusal:
    """The answer to a request that does not run. `queue_s` is the time that it has waited, if it has."""

    status: str
    error: str = ""
    queue_s: float = 0.0
    missing: tuple[bytes, ...] = ()
    waits_s: float = 0.0


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
        self._gathering = Gathering()
        self._runs = 0  # a run may hold several requests
        self._hurried = False  # whether any request has said when its answer is useless
        self._too_late_of: Counter[str] = Counter()  # by kind
        self.wakes_s = math.inf  # when held requests start at the latest
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
        if request.useless_s is not None:
            work.useless_s, self._hurried = work.arrived + request.useless_s, True
        kind = tasks.find_kind(request.kind)
        refusal = self._refusal(work, kind)
        if refusal is not None:
            self.refuse(peer, request, refusal)
            return
        if kind is not None and kind.together is not None:
            work.group = request.kind, request.key
            self._gathering.arrived(work.group, self._queue.groups[work.group], work.arrived)
        evicted = self._queue.add(work)
        if evicted is not None:
            self.refuse(evicted.peer, evicted.request, self._full())
        self._choose()

    def _refusal(self, work: Work, kind: tasks.Kind | None) -> Refusal | None:
        """Why this request cannot be accepted; None if it can, and then it has its blobs."""
        request = work.request
        if kind is None:
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
        return None if work.useless_s == math.inf else self._too_late(work, work.arrived)

    def _too_late(self, work: Work, now: float, *, waits: bool = True) -> Refusal | None:
        """Why the answer to this request cannot come in time; None if it can, or if nobody knows.

        Its run may be as short as the shortest one of its kind. One of TRIED_EVERY runs all the same.
        """
        kind = work.request.kind
        least_s = self._gathering.least_s(kind)
        if least_s is None:
            return None
        waits_s = self._waits_s(now) if waits else 0.0
        if now + waits_s + least_s <= work.useless_s:
            return None
        self._too_late_of[kind] += 1
        if self._too_late_of[kind] % TRIED_EVERY == 0:
            work.useless_s = math.inf
            return None
        self._metrics.too_late.labels(kind).inc()
        text = f"its answer would come after {waits_s + least_s:.3g} s, when nobody needs it"
        return Refusal("busy", text, waits_s=waits_s)

    def _waits_s(self, now: float) -> float:
        """How long a request that came now would wait: one run of each waiting robot, or as learned."""
        up = max(1, self._executor.up)
        if self._gathering.used:
            return self._gathering.waits_s(len(self._queue), up - self._runs, now)
        return max(0, self._queue.robots + self._runs - up) * self._queue.usual_s / up

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
        self.wakes_s = math.inf
        while self.warm and self._runs < self._executor.up:
            work = self._queue.next(self._startable if self._queue.groups else None)
            if work is None:
                return
            if self._starts(work):
                if work.group is not None:
                    self._gather(work, work.group)
                self._runs += 1
                self._chosen.append(work)

    def _starts(self, work: Work) -> bool:
        """Count a request as running, unless nobody needs its answer any more."""
        now = time.monotonic()
        work.queue_s = now - work.arrived
        if not self._access.knows(work.peer):
            self._queue.done(work, 0.0)
            self._count(work.request, "cancelled")
            return False
        refusal = Refusal("expired", queue_s=work.queue_s) if work.expired(now) else None
        if refusal is None and work.useless_s < math.inf:
            refusal = self._too_late(work, now, waits=False)
        if refusal is not None:
            self._queue.done(work, 0.0)
            self.refuse(work.peer, work.request, refusal)
            return False
        self._running.add(work)
        return True

    def _startable(self, work: Work) -> bool:
        """Whether a request may start now, or waits for others to run with it."""
        group = work.group
        together = None if group is None else tasks.kind_named(work.request.kind).together
        if group is None or together is None:
            return True
        now = time.monotonic()
        count = self._queue.groups[group]
        until_s = self._gathering.until_s(group, together, count, now)
        if until_s > now:
            useful_s = min(work.request.budget_s, work.useless_s - work.arrived)
            run_s = self._gathering.run_s(group[0], count) or 0.5 * useful_s  # until it is known
            until_s = min(until_s, work.arrived + useful_s - run_s)
        if until_s <= now:
            return True
        self.wakes_s = min(self.wakes_s, until_s)
        return False

    def _gather(self, work: Work, group: Group) -> None:
        """Find the requests that run together with this one."""
        together = tasks.kind_named(work.request.kind).together
        assert together is not None
        left = RUN_BYTES_MAX - byte_count(work.request.body)
        while len(work.more) + 1 < together.at_most and self._queue.groups[group]:
            other = self._queue.next(partial(_fits, group, left))
            if other is None:
                break
            if self._starts(other):
                work.more += (other,)
                left -= byte_count(other.request.body)
        count = 1 + len(work.more)
        work.number, held_s = self._gathering.began(group, count, time.monotonic())
        self._metrics.held_s_of(work.request.kind).observe(held_s)
        self._metrics.together_of(work.request.kind).observe(count)

    def wanted(self, work: Work) -> bool:
        """False if this run should stop: its answer is not wanted, or its robot may not have it.

        A run that must not be repeated goes on, within its budget. Called in any thread.
        """
        goes_on = work.wanted or (
            not tasks.kind_named(work.request.kind).duplicate and not work.expired(time.monotonic())
        )
        return goes_on and self._access.knows(work.peer)

    def answer(self, work: Work, outcome: Outcome) -> None:
        """A run has ended: send its replies."""
        self._runs -= 1
        if work.group is not None:
            self._ended(work, outcome)
        elif self._hurried and outcome.status == "ok":
            self._gathering.learn(work.request.kind, 1, outcome.run_s)
        if not work.more:
            self._answer(work, outcome)
            return
        works, work.more = (work, *work.more), ()
        if len(outcome.more) + 1 != len(works):  # the worker died, or had no memory: one may be the culprit
            outcome.together = len(works)
            for one in reversed(works):
                self._alone(one, outcome)
            return
        for one, its_own in zip(works, (outcome, *outcome.more), strict=True):
            self._answer(one, its_own)

    def _ended(self, work: Work, outcome: Outcome) -> None:
        """Learn from a run of a kind with `together`."""
        assert work.group is not None
        self._gathering.ended(work.number)
        if outcome.status == "ok" and outcome.together == 1 + len(work.more):
            self._gathering.learn(work.request.kind, outcome.together, outcome.run_s)
        self._gathering.answered(work.group, self._queue.groups[work.group], time.monotonic())
        self._failures.say(work.request.kind, outcome.note)

    def _alone(self, work: Work, outcome: Outcome) -> None:
        """A run has no outcomes: let this request of it wait again, to run alone, if it may run twice."""
        ran = outcome.status != "busy"
        if not work.wanted or (ran and not tasks.kind_named(work.request.kind).duplicate):
            self._answer(work, outcome)
            return
        self._running.discard(work)
        self._queue.put_back(work)

    def _answer(self, work: Work, outcome: Outcome) -> None:
        self._running.discard(work)
        self._queue.done(work, outcome.run_s / outcome.together)
        self.last_task = now = time.monotonic()
        request = work.request
        if outcome.queue_s:
            work.queue_s += outcome.queue_s
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
            if outcome.together > 1:
                reply.run_s = self._gathering.own_s(request.kind, outcome.together, outcome.run_s)
                reply.queue_s += outcome.run_s - reply.run_s
            if self._gathering.used:
                reply.waits_s = self._waits_s(now)
            self._sender.send(work.peer, reply)
        self._count(request, outcome.status if work.wanted else "cancelled", work.queue_s, outcome.run_s)
        self._metrics.queue_s_of(request.kind).observe(work.queue_s)
        self._metrics.run_s_of(request.kind).observe(outcome.run_s)
        if self._metrics.robots.counting:
            use = self._metrics.robots.of(work.robot)
            use.tasks += 1
            use.queue_s += work.queue_s
            use.run_s += outcome.run_s

    def waits_s(self) -> float:
        """How long a request that came now would wait; 0 if no requests run together here."""
        return self._waits_s(time.monotonic()) if self._gathering.used else 0.0

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
            queue_s=why.queue_s, queue_depth=len(self._queue), missing=why.missing, waits_s=why.waits_s,
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


def _fits(group: Group, bytes_left: int, work: Work) -> bool:
    return work.group == group and byte_count(work.request.body) <= bytes_left
