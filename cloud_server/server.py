"""The server: reads the messages of robots, and answers or hands on each of them."""

import logging
import math
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import zmq

from offboard.cloud_server.authorisation import Access, Authorisation
from offboard.cloud_server.connections import LOOK_S, Connections, OtherVersions, UnreadLimit, end, other_end
from offboard.cloud_server.executors.executor import Executor, Outcome
from offboard.cloud_server.fair_queue import Work
from offboard.cloud_server.metrics import Metrics, RobotUse, Status
from offboard.cloud_server.rate_limit import CUT_OFF_S, RateLimit, Verdict
from offboard.cloud_server.reader_threads import ReaderThreads
from offboard.cloud_server.robot_socket import ReplySender, bind_router
from offboard.cloud_server.scheduler import Refusal, Scheduler
from offboard.common import VERSION, tasks
from offboard.common.cpu_time import SELF
from offboard.common.errors import ConfigError, OffloadError, ProtocolError, TaskFailed, describe
from offboard.common.load import SERVER_EVERY_S, Load, LoadWatch
from offboard.common.logs import RareLog
from offboard.common.security.keys import KeyPair
from offboard.common.wire.blobs import BlobStore, Buffer, byte_length
from offboard.common.wire.channel import Channel, make_context
from offboard.common.wire.compression import compressions, decompress
from offboard.common.wire.messages import (
    Blob,
    Cancel,
    Hello,
    Message,
    Ping,
    Pong,
    Request,
    VersionMismatch,
    unpack,
)

POLL_S = 0.5
COPIED_BYTES_MAX = 64 * 1024  # a larger frame is used where libzmq has put it
RECEIVE_MAX = 64  # messages read in one turn
SEND_LAST_S = 1.0  # for the last replies to leave when the server stops

log = logging.getLogger("offboard.cloud_server")


@dataclass(frozen=True, slots=True)
class Limits:
    """What a server accepts: waiting requests, bytes, bytes per second of one robot, and time to stop."""

    queue_max: int
    blob_bytes_max: int
    message_bytes_max: int
    robot_bytes_per_s: float
    drain_s: float


class Server:
    """One socket for all robots, read by one thread at a time. Any thread may call `drain` and `status`.

    With `keys` all traffic is encrypted, and only robots whose public keys are in the folder `robots` are let
    in. `on_ready` is called once, when all workers are warm.
    """

    def __init__(
        self,
        listen: str,
        executor: Executor,
        metrics: Metrics,
        limits: Limits,
        *,
        on_ready: Callable[[], None] = lambda: None,
        keys: KeyPair | None = None,
        robots: Path | None = None,
    ) -> None:
        self.metrics = metrics
        self._executor = executor
        self._limits = limits
        self._on_ready = on_ready
        self._drain_until: float | None = None
        self._warming: Future[None] | None = None
        self._closed = False
        self._started = self._last_turn = time.monotonic()
        self._log = RareLog(log)
        self._context = make_context(f"--listen: {listen!r}")
        self._access = Access()
        if keys is not None and robots is not None:
            self._access = Authorisation(self._context, robots, metrics)
        self._socket = bind_router(self._context, listen, limits.message_bytes_max, keys)
        self.endpoint = self._socket.getsockopt_string(zmq.LAST_ENDPOINT)
        port, message_max = int(self.endpoint.rpartition(":")[2]), limits.message_bytes_max
        self._unread = UnreadLimit(
            port, message_max, limits.blob_bytes_max, metrics, encrypted=keys is not None
        )
        self._connections = Connections()
        self._look_due = self._started
        self._rate_limit = RateLimit(limits.robot_bytes_per_s, message_max)
        self._blobs = BlobStore(limits.blob_bytes_max)
        self._channel = Channel(self._socket)
        self._other_versions = OtherVersions()
        self._sender = ReplySender(self._channel, metrics, message_max, self._access.knows)
        self._load = LoadWatch(Load(SELF, own_s=executor.used_s), SERVER_EVERY_S)
        self._scheduler = Scheduler(
            executor, self._sender, metrics,
            blobs=self._blobs, queue_max=limits.queue_max, message_bytes_max=message_max,
            access=self._access, load=self._load,
        )  # fmt: skip
        self._readers = ReaderThreads(
            executor, turn=self._turn, answered=self._answered, wanted=self._scheduler.wanted, over=self._over
        )
        metrics.queue_depth.set_function(lambda: self._scheduler.waiting)
        metrics.running.set_function(lambda: self._scheduler.running)
        metrics.blob_bytes.set_function(lambda: self._blobs.byte_count)
        metrics.up.labels(executor.name).set_function(lambda: executor.up)
        metrics.load.set_function(lambda: self._latest_load()[0])
        metrics.capacity.set_function(lambda: self._latest_load()[1])

    def run(self) -> bool:
        """Serve until drained. True if every accepted request was answered."""
        try:
            with self._channel.lock:
                self._tend_executor()
            self._readers.run()
            with self._channel.lock:
                return self._scheduler.give_up() == 0
        finally:
            self._close()

    def _latest_load(self) -> tuple[float, float]:
        """Load and capacity of the computers that run the tasks."""
        return self._executor.load() or self._load.latest()

    def drain(self) -> None:
        """Accept no new requests, answer the accepted ones, then let `run` return."""
        if self._drain_until is None:
            self._drain_until = time.monotonic() + self._limits.drain_s
            self._scheduler.draining = True
        self._channel.wake()

    def status(self) -> Status:
        now, last_task = time.monotonic(), self._scheduler.last_task
        return Status(
            ready=self._scheduler.ready,
            draining=self._scheduler.draining,
            queue_depth=self._scheduler.waiting,
            running=self._scheduler.running,
            executor=self._executor.name,
            places=self._executor.places(),
            uptime_s=now - self._started,
            last_turn_age_s=now - self._last_turn,
            last_task_age_s=None if last_task is None else now - last_task,
        )

    def robots(self) -> list[dict[str, Any]]:
        """What each robot asked of this server since it is counted, and how many of its tasks wait now."""
        with self._channel.lock:
            uses, waiting = self.metrics.robots.counted(), self._scheduler.waiting_by_robot()
        nothing = asdict(RobotUse())
        return [
            {"robot": self._access.name_of(robot), **uses.get(robot, nothing), "waiting": waiting[robot]}
            for robot in dict.fromkeys([*uses, *waiting])
        ]

    def _turn(self) -> list[Work]:
        """Wait for messages and read them; returns the work to start."""
        wakes_s = self._scheduler.wakes_s
        held = wakes_s < math.inf
        self._channel.wait(max(0.0, min(POLL_S, wakes_s - time.monotonic())) if held else POLL_S)
        with self._channel.lock:
            now = self._last_turn = time.monotonic()
            self._tend_executor()
            for _ in range(RECEIVE_MAX):
                if not self._receive():
                    break
            self._scheduler.expire(now)
            if now >= self._look_due:
                self._look_due = now + LOOK_S
                for peer in self._scheduler.peers():
                    if self._connections.ended(peer):
                        self._scheduler.cancel(peer)  # nobody can have the answers
            return self._scheduler.take_chosen()

    def _tend_executor(self) -> None:
        """Start the executor, and notice when it is warm."""
        if self._warming is None:
            self._warming = self._executor.warm(self._worker_changed)
            self._warming.add_done_callback(lambda _: self._channel.wake())
        elif not self._scheduler.warm and self._warming.done():
            error = self._warming.exception()
            if error is not None:
                if isinstance(error, TaskFailed):
                    text = "the server cannot start; remedy: correct the setup of that task\n%s"
                    log.error(text, error.traceback.rstrip())
                if isinstance(error, ConfigError):
                    raise error
                raise OffloadError(
                    str(error) if isinstance(error, OffloadError) else describe(error)
                ) from error
            self._scheduler.warm = True
            self._on_ready()

    def _worker_changed(self, died: str) -> None:
        """Called in the thread of a worker."""
        if died:
            self.metrics.restarts.labels(died).inc()
        self._channel.wake()

    def _receive(self) -> bool:
        """Read one message; False if there is none."""
        message = self._channel.receive()
        if message is None:
            return False
        peer, *raw = message
        sizes = [len(frame) for frame in raw]
        file = int(peer.get(zmq.SRCFD))
        self._unread.took(file, sizes)
        if not self._access.lets_in(peer):
            return True
        self._connections.heard(peer.bytes, file)
        size = sum(sizes)
        self.metrics.bytes_in.inc(size)
        verdict = self._rate_limit.judge(self._access.robot_of(peer.bytes), size, self._last_turn)
        if verdict in (Verdict.DROP, Verdict.CUT_OFF):
            self.metrics.dropped.labels("quota").inc()
            if verdict is Verdict.CUT_OFF:
                self._cut_off(peer.bytes, file)
            return True
        frames: list[Buffer] = [f.buffer if len(f) > COPIED_BYTES_MAX else f.bytes for f in raw]
        try:
            most = self._limits.message_bytes_max
            if size > most:
                raise ProtocolError(f"message of {size} bytes, at most {most} are allowed")
            self._take(peer.bytes, file, unpack(frames), verdict)
        except VersionMismatch as error:
            self._drop("version", error)
            self._sender.send(peer.bytes, self._hello())
        except ProtocolError as error:
            self._drop("malformed", error)
        return True

    def _cut_off(self, peer: bytes, file: int) -> None:
        """Close the connection of a robot that sends too much, and refuse its next ones for a while."""
        self.metrics.cut_off.inc()
        name, address = self._access.shut_out(peer, CUT_OFF_S), other_end(file)
        log.warning(
            "cut off %s at %s for %g s: it sends far more than --robot-mib-s allows; "
            "remedy: if it is yours, raise --robot-mib-s",
            name,
            address,
            CUT_OFF_S,
        )
        end(file, address)

    def _take(self, peer: bytes, file: int, message: Message, verdict: Verdict) -> None:
        match message:
            case Request() if verdict is Verdict.REFUSE:
                why = Refusal("busy", "more bytes or messages per second than one robot may send")
                self._scheduler.refuse(peer, message, why)
            case _ if verdict is Verdict.REFUSE:
                self.metrics.dropped.labels("quota").inc()
            case Request():
                self._scheduler.request(peer, message)
            case Blob(data, None):
                self._blobs.add(data, self._access.robot_of(peer))
            case Blob(data, int(size)):
                self._decompress(peer, file, data, size)
            case Ping(id):
                self._connections.pings(peer)
                state = self._scheduler.waiting, *self._latest_load(), self._scheduler.waits_s()
                self._sender.send(peer, Pong(id, *state))
            case Hello():
                self._other_versions.hear(message)
                # Robots repeat their hello until it is answered, and send no task before that.
                if self._scheduler.ready and not self._scheduler.draining:
                    self._sender.send(peer, self._hello())
            case Cancel(id):
                self._scheduler.cancel(peer, id)
            case _:
                raise ProtocolError(f"a server does not accept a {type(message).__name__.lower()}")

    def _decompress(self, peer: bytes, file: int, data: Buffer, size: int) -> None:
        """Keep a compressed blob. It counts with all its bytes, because they are hashed and kept."""
        if size > self._limits.message_bytes_max:
            raise ProtocolError(f"blob of {size} bytes once it is decompressed")
        robot, more = self._access.robot_of(peer), max(0, size - byte_length(data))
        verdict = self._rate_limit.judge(robot, more, self._last_turn)
        if verdict is Verdict.TAKE:
            self._blobs.add(decompress(data, size), robot)
            return
        self.metrics.dropped.labels("quota").inc()
        if verdict is Verdict.CUT_OFF:
            self._cut_off(peer, file)

    def _answered(self, work: Work, outcome: Outcome) -> list[Work]:
        """Send the reply of a task; returns the work to start in its place."""
        with self._channel.lock:
            if self._closed:
                return []
            self._scheduler.answer(work, outcome)
            chosen = self._scheduler.take_chosen()
            held = self._scheduler.wakes_s < math.inf
        if held or self._drain_until is not None:
            self._channel.wake()  # the reading thread must look in time, or leave
        return chosen

    def _hello(self) -> Hello:
        return Hello(tasks.hashes(), VERSION, self._limits.message_bytes_max, compressions())

    def _drop(self, reason: str, error: ProtocolError) -> None:
        self.metrics.dropped.labels(reason).inc()
        text = f"dropped a message: {error}; remedy: find out who sends it"
        self._log(logging.WARNING, text, self._last_turn)

    def _over(self) -> bool:
        """True if the server may stop: it is drained, or the time for that is over."""
        if self._closed:
            return True
        if self._drain_until is None:
            return False
        idle = not self._scheduler.waiting and not self._scheduler.running
        return idle or time.monotonic() >= self._drain_until

    def _close(self) -> None:
        with self._channel.lock:
            self._closed = True
        self._channel.wake()
        self._readers.leave(SEND_LAST_S)
        self._load.close()
        self._executor.close()
        self._unread.close()
        with self._channel.lock:
            self._socket.close(linger=int(SEND_LAST_S * 1000))
        self._context.term()
        self._channel.close()
