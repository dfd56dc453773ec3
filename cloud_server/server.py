"""The ROUTER loop: takes requests from robots and hands them to the executor, whose threads send the replies.

It never waits for work; who reads and who runs tasks is `crew`, what runs them `executors`.
"""

import logging
import os
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path

import zmq

from offboard.cloud_server.authorisation import ZAP_DOMAIN, Robots
from offboard.cloud_server.executors import Executor, Outcome
from offboard.cloud_server.fair_queue import CRASHES_MAX, Crashes, Waiting, Work
from offboard.cloud_server.metrics import Metrics, Status
from offboard.cloud_server.rate_limit import CUT_OFF_S, Quota, Verdict
from offboard.cloud_server.reader_threads import Crew
from offboard.cloud_server.reply_queue import Outbox
from offboard.cloud_server.tcp_connections import Backlog, end, other_end
from offboard.common import VERSION, tasks
from offboard.common.errors import ConfigError, OffloadError, ProtocolError
from offboard.common.host.cgroup import SELF
from offboard.common.host.load import SERVER_EVERY_S, Load
from offboard.common.host.load_watch import LoadWatch
from offboard.common.security.keys import KeyPair
from offboard.common.wire.blobs import BlobStore, Buffer
from offboard.common.wire.channel import Channel
from offboard.common.wire.messages import (
    Blob,
    Cancel,
    Hello,
    Message,
    Ping,
    Pong,
    Reply,
    Request,
    VersionMismatch,
    byte_count,
    unpack,
)

POLL_S = 0.5
COPIED_BYTES_MAX = 64 * 1024  # a larger frame is used where the transport put it
RECEIVE_MAX = 64  # messages taken in one turn
PEER_MESSAGES_MAX = 256  # unsent replies, and unread requests, of one robot
HANDSHAKE_S = 10.0  # for who connects to say who it is
# Until a robot that is silent counts as gone: seconds, seconds, questions that are not answered.
KEEPALIVE_IDLE_S, KEEPALIVE_EVERY_S, KEEPALIVE_PROBES = 60, 10, 6
SEND_LAST_S = 1.0  # time for the last replies to leave when the server stops
LOG_PAUSE_S = 10.0  # least time between two warnings about bad messages

log = logging.getLogger("offboard.cloud_server")


class Server:
    """One socket, read by one thread. `drain` and `status` may be called from others.

    With `keys` everything is encrypted, and only the robots whose public keys are in `robots` are let in.
    """

    def __init__(
        self,
        listen: str,
        executor: Executor,
        metrics: Metrics,
        *,
        queue_max: int,
        blob_bytes_max: int,
        message_bytes_max: int,
        robot_bytes_a_s: float,
        drain_s: float,
        on_ready: Callable[[], None] = lambda: None,
        keys: KeyPair | None = None,
        robots: Path | None = None,
    ) -> None:
        self.metrics = metrics
        self._executor = executor
        self._waiting = Waiting(queue_max)
        self._crashes = Crashes()
        self._running: set[Work] = set()
        self._blobs = BlobStore(blob_bytes_max)
        self._message_bytes_max = message_bytes_max
        self._quota = Quota(robot_bytes_a_s, message_bytes_max)
        self._drain_s = drain_s
        self._drain_until: float | None = None
        self._on_ready = on_ready
        self._warming: Future[None] | None = None
        self._warm = False
        self._started = self._last_turn = time.monotonic()
        self._last_task: float | None = None
        self._last_warning = -float("inf")
        self._context = zmq.Context()
        self._robots: Robots | None = None
        if keys is not None and robots is not None:
            self._robots = Robots(self._context, robots, metrics)
        self._socket = _bind(self._context, listen, message_bytes_max, keys)
        self.endpoint = self._socket.getsockopt_string(zmq.LAST_ENDPOINT)
        port = int(self.endpoint.rpartition(":")[2])
        self._backlog = Backlog(port, message_bytes_max, blob_bytes_max, metrics, encrypted=keys is not None)
        self._channel = Channel(self._socket)
        self._outbox = Outbox(self._channel, metrics, message_bytes_max, self._knows)
        self._crew = Crew(
            executor, turn=self._turn, answered=self._answered, wanted=self._wanted, over=self._over
        )
        self._load = LoadWatch(Load(SELF, own_s=executor.used_s), SERVER_EVERY_S)
        self._closed = False
        self._chosen: list[Work] = []  # to be started by who chose it
        metrics.queue_depth.set_function(lambda: len(self._waiting))
        metrics.running.set_function(lambda: len(self._running))
        metrics.blob_bytes.set_function(lambda: self._blobs.byte_count)
        metrics.load.set_function(lambda: self._load.latest()[0])
        metrics.capacity.set_function(lambda: self._load.latest()[1])

    def run(self) -> bool:
        """Serve until drained; True when everything that was accepted has been answered."""
        try:
            with self._channel.lock:
                self._tend_executor()
            self._crew.run()
            with self._channel.lock:
                return self._give_up_rest() == 0
        finally:
            self._close()

    def drain(self) -> None:
        """Take no new requests, answer the accepted ones, then let `run` return."""
        if self._drain_until is None:
            self._drain_until = time.monotonic() + self._drain_s
        self._channel.wake()

    def status(self) -> Status:
        now = time.monotonic()
        return Status(
            ready=self._ready,
            draining=self._drain_until is not None,
            queue_depth=len(self._waiting),
            running=len(self._running),
            uptime_s=now - self._started,
            last_turn_age_s=now - self._last_turn,
            last_task_age_s=None if self._last_task is None else now - self._last_task,
        )

    def _turn(self) -> list[Work]:
        """Wait for messages and take them; the work to start."""
        self._channel.wait(POLL_S)
        with self._channel.lock:
            now = self._last_turn = time.monotonic()
            self._tend_executor()
            for _ in range(RECEIVE_MAX):
                if not self._receive():
                    break
            for work in self._waiting.take(lambda work: work.expired(self._last_turn)):
                self._refuse(work.peer, work.request, "expired", queue_s=now - work.arrived)
            self._choose()
            chosen, self._chosen = self._chosen, []
        return chosen

    def _tend_executor(self) -> None:
        """Start the executor, and see when it is warm."""
        if self._warming is None:
            self._warming = self._executor.warm(self._worker_changed)
            self._warming.add_done_callback(lambda _: self._channel.wake())
        elif not self._warm and self._warming.done():
            self._warmed(self._warming.exception())

    @property
    def _ready(self) -> bool:
        """Once all workers are warm, while any of them is up."""
        return self._warm and self._executor.up > 0

    def _warmed(self, error: BaseException | None) -> None:
        if error is not None:
            raise OffloadError(f"tasks could not be warmed up: {type(error).__name__}: {error}") from error
        self._warm = True
        self._on_ready()

    def _worker_changed(self, died: str) -> None:
        """Called in a worker's thread."""
        if died:
            self.metrics.restarts.labels(died).inc()
        self._channel.wake()

    def _receive(self) -> bool:
        """Take one message, if there is one."""
        message = self._channel.receive()
        if message is None:
            return False
        peer, *raw = message
        sizes = [len(frame) for frame in raw]
        file = int(peer.get(zmq.SRCFD))
        self._backlog.took(file, sizes)
        if self._robots is not None and not self._robots.lets_in(peer):
            return True
        size = sum(sizes)
        self.metrics.bytes_in.inc(size)
        verdict = self._quota.judge(self._robot_of(peer.bytes), size, self._last_turn)
        if verdict in (Verdict.DROP, Verdict.CUT_OFF):
            self.metrics.dropped.labels("quota").inc()
            if verdict is Verdict.CUT_OFF:
                self._cut_off(peer.bytes, file)
            return True
        frames: list[Buffer] = [f.buffer if len(f) > COPIED_BYTES_MAX else f.bytes for f in raw]
        try:
            if size > self._message_bytes_max:
                raise ProtocolError(f"message of {size} bytes, at most {self._message_bytes_max} are allowed")
            self._take(peer.bytes, unpack(frames), verdict)
        except VersionMismatch as error:
            self._drop("version", error)
            self._outbox.send(peer.bytes, self._hello())
        except ProtocolError as error:
            self._drop("malformed", error)
        return True

    def _cut_off(self, peer: bytes, file: int) -> None:
        """End a connection that sends more and more; a robot that is known is not let in for a while."""
        self.metrics.cut_off.inc()
        name = other_end(file) if self._robots is None else self._robots.shut_out(peer, CUT_OFF_S)
        log.warning("cut off %s for %g s: it sends far more than one robot may", name, CUT_OFF_S)
        end(file, other_end(file))

    def _take(self, peer: bytes, message: Message, verdict: Verdict) -> None:
        match message:
            case Request() if verdict is Verdict.REFUSE:
                self._refuse(peer, message, "busy", "more bytes or messages a second than one robot may send")
            case _ if verdict is Verdict.REFUSE:
                self.metrics.dropped.labels("quota").inc()
            case Request():
                self._request(peer, message)
            case Blob(data):
                self._blobs.add(data, self._robot_of(peer))
            case Ping(id):
                self._outbox.send(peer, Pong(id, len(self._waiting), *self._load.latest()))
            case Hello():
                # Robots ask again until they are answered, and send no task before that.
                if self._ready and self._drain_until is None:
                    self._outbox.send(peer, self._hello())
            case Cancel(id):
                self._cancel(peer, id)
            case _:
                raise ProtocolError(f"a server takes no {type(message).__name__.lower()}")

    def _request(self, peer: bytes, request: Request) -> None:
        """Put the request in line, or say why not."""
        work = Work(peer, request, {}, time.monotonic(), self._robot_of(peer))
        if not tasks.is_kind(request.kind):
            self._refuse(peer, request, "unknown_task", f"no task named {request.kind!r} on this server")
        elif self._crashes.too_many(peer, request.id):
            self._refuse(peer, request, "failed", f"its worker died {CRASHES_MAX} times; it is not run again")
        elif self._drain_until is not None:
            self._refuse(peer, request, "busy", "the server is stopping")
        elif not self._ready:
            self._refuse(peer, request, "busy", "the server is warming up")
        elif self._waiting.closed_to(work.robot):
            self._refuse(peer, request, "busy", f"{len(self._waiting)} requests are waiting")
        elif missing := self._pin(work):
            self._refuse(peer, request, "need_blob", missing=missing)
        elif self._waiting.bytes_with(work) > self._held_bytes_max:
            self._refuse(peer, request, "busy", "waiting requests hold all the memory allowed")
        else:
            evicted = self._waiting.add(work)
            if evicted is not None:
                self._refuse(
                    evicted.peer, evicted.request, "busy", f"{len(self._waiting)} requests are waiting"
                )
            self._choose()

    @property
    def _held_bytes_max(self) -> int:
        return self._blobs.bytes_max + self._message_bytes_max

    def _robot_of(self, peer: bytes) -> bytes:
        return peer if self._robots is None else self._robots.of(peer)

    def _pin(self, work: Work) -> tuple[bytes, ...]:
        """Give the work its blobs; the digests of those not here."""
        for digest in work.request.blobs:
            blob = self._blobs.get(digest)
            if blob is not None:
                work.blobs[digest] = blob
        return tuple(digest for digest in work.request.blobs if digest not in work.blobs)

    def _choose(self) -> None:
        """Waiting work for the workers that are free: it counts as running."""
        while self._ready and len(self._running) < self._executor.up:
            work = self._waiting.next()
            if work is None:
                return
            now = time.monotonic()
            work.queue_s = now - work.arrived
            if not self._knows(work.peer):
                self._waiting.done(work, 0.0)
                self._count(work.request, "cancelled")
                continue
            if work.expired(now):
                self._waiting.done(work, 0.0)
                self._refuse(work.peer, work.request, "expired", queue_s=work.queue_s)
                continue
            self._running.add(work)
            self._chosen.append(work)

    def _wanted(self, work: Work) -> bool:
        return work.wanted and self._knows(work.peer)

    def _answered(self, work: Work, outcome: Outcome) -> list[Work]:
        """Answer it; the work to start in its place."""
        with self._channel.lock:
            if self._closed:
                return []
            self._answer(work, outcome)
            self._choose()
            chosen, self._chosen = self._chosen, []
        if self._drain_until is not None:
            self._channel.wake()
        return chosen

    def _answer(self, work: Work, outcome: Outcome) -> None:
        self._running.discard(work)
        self._waiting.done(work, outcome.run_s)
        self._last_task = time.monotonic()
        request = work.request
        if outcome.crashed:
            self._crashes.note(work.peer, request.id)
        size = byte_count(outcome.frames)
        if size > self._message_bytes_max:
            error = f"BadValue: the result takes {size} bytes, at most {self._message_bytes_max} are allowed"
            outcome = replace(outcome, status="failed", error=error, frames=[], server_fault=True)
        if work.wanted:
            self._load.hurry()  # what was taken during the task, not before it
            load, capacity = self._load.latest()
            self._outbox.send(
                work.peer,
                Reply(
                    request.id,
                    outcome.status,
                    outcome.error,
                    work.queue_s,
                    outcome.run_s,
                    len(self._waiting),
                    server_fault=outcome.server_fault,
                    body=outcome.frames,
                    cpu_s=outcome.cpu_s,
                    load=load,
                    capacity=capacity,
                ),
            )
        self._count(request, outcome.status if work.wanted else "cancelled")
        self.metrics.queue_s.labels(request.kind).observe(work.queue_s)
        self.metrics.run_s.labels(request.kind).observe(outcome.run_s)

    def _cancel(self, peer: bytes, id: int) -> None:
        for work in self._waiting.take(lambda work: work.peer == peer and work.request.id == id):
            self._count(work.request, "cancelled")
        for work in self._running:
            if work.peer == peer and work.request.id == id:
                work.wanted = False

    def _refuse(
        self,
        peer: bytes,
        request: Request,
        status: str,
        error: str = "",
        *,
        queue_s: float = 0.0,
        missing: tuple[bytes, ...] = (),
    ) -> None:
        self._count(request, status)
        depth = len(self._waiting)
        self._outbox.send(
            peer, Reply(request.id, status, error, queue_s=queue_s, queue_depth=depth, missing=missing)
        )

    def _count(self, request: Request, status: str) -> None:
        # A robot can send any name; a label for each would grow without bound.
        kind = "unknown" if status == "unknown_task" else request.kind
        self.metrics.requests.labels(kind, status).inc()

    def _hello(self) -> Hello:
        known = {kind.name: kind.source_hash for kind in tasks.kinds()}
        return Hello(known, VERSION, self._message_bytes_max)

    def _knows(self, peer: bytes) -> bool:
        return self._robots is None or self._robots.knows(peer)

    def _drop(self, reason: str, error: ProtocolError) -> None:
        self.metrics.dropped.labels(reason).inc()
        if self._last_turn - self._last_warning >= LOG_PAUSE_S:
            self._last_warning = self._last_turn
            log.warning("dropped a message: %s (more within %g s are only counted)", error, LOG_PAUSE_S)

    def _over(self) -> bool:
        if self._closed:
            return True
        if self._drain_until is None:
            return False
        idle = not self._waiting and not self._running
        return idle or time.monotonic() >= self._drain_until

    def _give_up_rest(self) -> int:
        """Tell whoever still waits, and how many are left. What runs hears the connection break instead:
        `busy` would say that it never ran."""
        waiting = self._waiting.take(lambda _: True)
        for work in waiting:
            self._refuse(work.peer, work.request, "busy", "the server stopped")
        return len(waiting) + len(self._running)

    def _close(self) -> None:
        with self._channel.lock:
            self._closed = True
        self._channel.wake()
        self._crew.leave(SEND_LAST_S)
        self._load.close()
        self._executor.close()
        self._backlog.close()
        with self._channel.lock:
            self._socket.close(linger=int(SEND_LAST_S * 1000))
        self._context.term()
        self._channel.close()


def _bind(
    context: "zmq.Context[zmq.Socket[bytes]]", listen: str, message_bytes_max: int, keys: KeyPair | None
) -> "zmq.Socket[bytes]":
    router = context.socket(zmq.ROUTER)
    router.setsockopt(zmq.LINGER, 0)
    router.setsockopt(zmq.ROUTER_MANDATORY, 1)  # a reply that cannot go is an error here, so it is counted
    router.setsockopt(zmq.MAXMSGSIZE, message_bytes_max)
    router.setsockopt(zmq.SNDHWM, PEER_MESSAGES_MAX)
    router.setsockopt(zmq.RCVHWM, PEER_MESSAGES_MAX)
    router.setsockopt(zmq.HANDSHAKE_IVL, int(HANDSHAKE_S * 1000))
    router.setsockopt(zmq.TCP_KEEPALIVE, 1)
    router.setsockopt(zmq.TCP_KEEPALIVE_IDLE, KEEPALIVE_IDLE_S)
    router.setsockopt(zmq.TCP_KEEPALIVE_INTVL, KEEPALIVE_EVERY_S)
    router.setsockopt(zmq.TCP_KEEPALIVE_CNT, KEEPALIVE_PROBES)
    router.setsockopt(zmq.IPV6, int("[" in listen))
    if keys is not None:
        router.setsockopt(zmq.CURVE_SERVER, 1)
        router.setsockopt(zmq.CURVE_SECRETKEY, keys.secret)
        router.setsockopt(zmq.ZAP_DOMAIN, ZAP_DOMAIN)
        router.setsockopt(zmq.ZAP_ENFORCE_DOMAIN, 1)  # were nobody there to ask, nobody would be let in
    try:
        router.bind(listen)
    except zmq.ZMQError as error:
        router.close()
        context.term()
        raise ConfigError(f"--listen: {listen!r} cannot be bound: {os.strerror(error.errno or 0)}") from error
    return router
