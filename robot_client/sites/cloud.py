"""The runner of a remote site: one DEALER socket; whoever asks sends himself, and reads if he is alone.

Answers are matched by id; whatever arrives late is dropped. What a message looks like is `wire.messages`.
"""

import contextlib
import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import zmq
import zmq.utils.monitor

from offboard.common import VERSION as SOFTWARE
from offboard.common.errors import (
    BadValue,
    CloudBroken,
    CloudBusy,
    CloudError,
    CloudTimeout,
    ConfigError,
    OffloadError,
    Overtaken,
    ProtocolError,
    TaskFailed,
)
from offboard.common.security.exposure import on_loopback
from offboard.common.security.keys import RobotKeys
from offboard.common.tasks import Kind, Task, kinds
from offboard.common.wire import messages as wire
from offboard.common.wire.channel import Channel, readable
from offboard.robot_client.sites.heartbeat import ALONG_S, Heartbeat, Told
from offboard.robot_client.sites.own_cpu import OWN_CPU
from offboard.robot_client.sites.runner import CLOUD, Condition, Execution, check_endpoint
from offboard.robot_client.sites.turns import Answer, Turns
from offboard.robot_client.sites.uploads import Uploads

PENDING_MAX = 1024
ATTEMPTS_MAX = 4  # sends of one request: the first, and one after each `need_blob`
MESSAGE_BYTES_MAX = 256 * 1024 * 1024
SEND_QUEUE_MAX = 1000  # messages, per socket
HELLO_EVERY_S = 1.0  # until it is answered; a server that refused the handshake is asked as often
RECONNECT_MS, RECONNECT_MAX_MS = 100, 1000
# TCP alone may take a quarter of an hour to notice a peer that vanished without a word. ZMQ's own
# heartbeats would wait behind a large argument and break a slow link that works.
UNACKNOWLEDGED_MS = 15_000
KEEPALIVE_IDLE_S, KEEPALIVE_EVERY_S, KEEPALIVE_PROBES = 10, 5, 2
CLOSE_WAIT_S = 2.0
REFUSED = "it does not know this robot's key"
UNFIT = "the handshake failed: the connection broke, or keys do not fit the server's"
HANDSHAKE_FAILURES: dict[int, tuple[str, bool]] = {  # and whether libzmq tries no more
    zmq.EVENT_HANDSHAKE_FAILED_AUTH: (REFUSED, True),
    zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL: (UNFIT, True),
    zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL: (UNFIT, False),
}
IDLE_WAIT_S = 1.0

log = logging.getLogger(__name__)


@dataclass(eq=False)
class _Pending:
    """A request in flight."""

    task: Task
    body: wire.Body
    published: float
    deadline: float
    future: "Future[Execution]"
    along: bool  # whether large arguments are in the body
    attempt: int = 1
    bytes_out: int = 0
    sent_as: int = 0  # number of the last message it was sent in
    asks: bool = False  # whether the server has a blob of it is not known


class CloudRunner:
    """Runs tasks on the server at `endpoint` (tcp://HOST:PORT).

    The site is available for a kind once the server has answered `hello` on the present connection with
    the same protocol version and the same source for that kind. `heartbeat_s`: seconds between heartbeats;
    0: none, and nothing is measured but tasks. `keys`: encrypted, and with the server of this key alone.
    """

    def __init__(
        self,
        endpoint: str,
        *,
        site: str = CLOUD,
        heartbeat_s: float = 0.0,
        seed: int = 0,
        keys: RobotKeys | None = None,
    ) -> None:
        check_endpoint(site, endpoint)
        self.site = site
        self._heartbeat = Heartbeat(heartbeat_s, seed, OWN_CPU)
        self._endpoint = endpoint
        self._absent: str | None = f"no answer from {endpoint} yet"
        self._remote: dict[str, str] = {}
        self._message_bytes_max = MESSAGE_BYTES_MAX  # what the server takes, once it said so
        self._told: set[str] = set()
        self._pending: dict[int, _Pending] = {}
        self._unwanted: deque[int] = deque()
        self._asked = False  # to find out whether the server is there
        self._turns = Turns(
            self._tend,
            self._receive,
            asked=self._pending.__len__,
            expected=self._expected,
            wake=self._wake,
        )
        self._looks_s = -math.inf  # when whoever waits for messages looks again, whatever happens
        self._handshake_failure = ""  # the last one's, until one succeeds
        self._given_up = False  # by libzmq, after such a failure
        self._hello_due = math.inf
        self._messages = 0
        self._uploads = Uploads()
        self._context = zmq.Context()
        try:
            self._socket, self._monitor = _connect(self._context, endpoint, keys)
        except zmq.ZMQError as error:
            self._context.destroy(linger=0)
            raise ConfigError(f"{site}: endpoint {endpoint!r}: {error}") from error
        self._channel = Channel(self._socket, self._monitor.FD)
        if keys is None:
            _warn_of_plain_text(site, endpoint)
        self._thread = threading.Thread(target=self._run, name=f"site-{site}", daemon=True)
        self._thread.start()

    def unavailable(self, kind: Kind) -> str | None:
        if self._absent is not None:
            return self._absent
        if self._remote.get(kind.name) == kind.source_hash != "":
            return None
        why = (
            f"task {kind.name} is not the same there"
            if kind.name in self._remote
            else f"no task {kind.name} there"
        )
        if kind.name not in self._told:
            self._told.add(kind.name)
            log.warning("%s: %s: it stays onboard", self.site, why)
        return why

    def submit(self, task: Task, budget_s: float) -> "Future[Execution]":
        published = time.perf_counter()
        try:
            along = self._uploads.along(task.kind.name, self._message_bytes_max)
            body = wire.encode(list(task.args), task.kind.types, blobs=True, along=along)
        except BadValue as error:
            return self._refused(BadValue(f"task {task.kind.name}: {error}"))
        largest = max([wire.byte_count(body.frames), *(raw.nbytes for raw in body.blobs.values())])
        if largest > self._message_bytes_max - wire.HEADER_BYTES_MAX:
            failure = f"{largest} bytes of arguments; the server takes messages of {self._message_bytes_max}"
            return self._refused(CloudBroken(failure))
        if len(self._pending) >= PENDING_MAX:
            return self._refused(CloudBusy(f"{PENDING_MAX} tasks are in flight"))
        pending = _Pending(task, body, published, published + budget_s, Answer(self._turns), along.used)
        with self._channel.lock:
            if self._turns.closed:
                pending.future.cancel()
                return pending.future
            self._pending[task.id] = pending
            self._beat(early_s=ALONG_S)
            self._send_first(pending)
            if pending.deadline < self._looks_s:
                self._channel.wake()
        return pending.future

    def cancel(self, task: Task) -> None:
        self._unwanted.append(task.id)
        self._turns.call()

    def hurry(self) -> None:
        self._asked = True
        self._turns.call()

    def condition(self) -> Condition:
        return self._heartbeat.condition(time.perf_counter())

    def close(self) -> None:
        self._turns.close()
        self._thread.join(CLOSE_WAIT_S)

    def _refused(self, failure: OffloadError) -> "Future[Execution]":
        future: Future[Execution] = Future()
        future.set_result(Execution(self.site, 0.0, failure=failure, started=False))
        return future

    def _expected(self) -> bool:
        return bool(self._pending or self._heartbeat.unanswered)

    def _wake(self) -> None:
        self._channel.wake()

    def _run(self) -> None:
        try:
            self._turns.run(IDLE_WAIT_S)
        finally:
            self._shut_down()

    # What follows runs in the thread whose turn it is, but for sending a request.

    def _tend(self) -> None:
        """What is due."""
        with self._channel.lock:
            self._watch_connection()
            while self._unwanted:
                self._give_up(self._unwanted.popleft())
            self._expire()
            self._beat()

    def _receive(self, wait_s: float) -> None:
        with self._channel.lock:
            now_s = time.perf_counter()
            due = [pending.deadline for pending in self._pending.values()]
            self._looks_s = min([now_s + wait_s, self._hello_due, self._heartbeat.due_s, *due])
        self._channel.wait(self._looks_s - now_s)
        with self._channel.lock:
            self._looks_s = -math.inf
            while frames := self._channel.receive():
                self._read(frames, time.perf_counter())

    def _watch_connection(self) -> None:
        while readable(self._monitor):
            event = zmq.utils.monitor.recv_monitor_message(self._monitor)["event"]
            if event == zmq.EVENT_HANDSHAKE_SUCCEEDED:
                self._handshake_failure, self._given_up = "", False
                self._say_hello()
            elif event in HANDSHAKE_FAILURES:
                failure, self._given_up = HANDSHAKE_FAILURES[event]
                if failure == REFUSED != self._handshake_failure:
                    log.warning("%s: %s: %s; asking again", self.site, self._endpoint, failure)
                self._handshake_failure = failure
            elif event == zmq.EVENT_DISCONNECTED:
                self._hello_due = math.inf
                self._heartbeat.stop()
                if self._absent is None:
                    log.warning("%s: connection to %s lost", self.site, self._endpoint)
                self._absent = f"not connected to {self._endpoint}"
                if self._handshake_failure:
                    self._absent += f": {self._handshake_failure}"
                if self._given_up:
                    self._hello_due = time.perf_counter() + HELLO_EVERY_S
                self._uploads.forget()
                for request_id in list(self._pending):
                    self._finish(request_id, CloudBroken("the connection was lost"))

    def _say_hello(self) -> None:
        self._hello_due = time.perf_counter() + HELLO_EVERY_S
        if self._given_up:
            self._connect_again()
            return
        known = {kind.name: kind.source_hash for kind in kinds()}
        self._send(wire.Hello(known, SOFTWARE, MESSAGE_BYTES_MAX))

    def _connect_again(self) -> None:
        self._hello_due, self._given_up = math.inf, False
        with contextlib.suppress(zmq.ZMQError):  # there is no connection to end
            self._socket.disconnect(self._endpoint)
        self._socket.connect(self._endpoint)

    def _beat(self, early_s: float = 0.0) -> None:
        now_s = time.perf_counter()
        if self._asked:
            self._asked = False
            self._heartbeat.hurry(now_s)
        if self._heartbeat.due_s <= now_s + early_s:
            self._send(wire.Ping(self._heartbeat.beat(now_s)))

    def _give_up(self, request_id: int) -> None:
        """Nobody waits for the answer any more."""
        if request_id in self._pending:
            self._send(wire.Cancel(request_id))
            self._finish(request_id, Overtaken("another site answered first"), censored=True)
            self._heartbeat.hurry(time.perf_counter())

    def _send_first(self, pending: _Pending) -> None:
        """Blobs that the server may have are only named, unless those of this kind are always new."""
        body, kind = pending.body, pending.task.kind.name
        unknown = self._uploads.unknown(body)
        if unknown and self._uploads.often_new(kind):
            self._upload(pending, unknown)
        elif unknown:
            pending.asks = True
        elif body.blobs and not pending.along:
            self._uploads.found(kind, new=False)
        self._send_request(pending)

    def _send_request(self, pending: _Pending) -> None:
        left_s = pending.deadline - time.perf_counter()
        if left_s > 0:
            task, body = pending.task, pending.body
            request = wire.Request(
                task.id, task.kind.name, left_s, pending.attempt, tuple(body.blobs), body.frames
            )
            sent = self._send(request)
            pending.bytes_out += sent
            pending.sent_as = self._messages
            if not sent:
                self._finish(pending.task.id, CloudBroken("nothing can be sent"), started=False)

    def _send(self, message: wire.Message) -> int:
        """Bytes handed over; 0 where there is no connection or its queue is full."""
        frames = wire.pack(message)
        try:
            self._channel.send(frames)
        except zmq.Again:
            return 0
        self._messages += 1
        return wire.byte_count(frames)

    def _read(self, frames: Iterable[zmq.Frame], received: float) -> None:
        buffers = [frame.buffer for frame in frames]
        try:
            self._take(wire.unpack(buffers), received, wire.byte_count(buffers))
        except wire.VersionMismatch as error:
            self._absent, self._hello_due = str(error), math.inf
            log.warning("%s: %s: tasks stay onboard", self.site, error)
        except ProtocolError as error:
            log.warning("%s: message dropped: %s", self.site, error)

    def _take(self, message: wire.Message, received: float, bytes_in: int) -> None:
        if isinstance(message, wire.Hello):
            self._hello_due = math.inf
            self._remote, self._message_bytes_max = message.tasks, message.message_bytes_max
            if self._absent is not None:
                log.info("%s: %s is up", self.site, self._endpoint)
                self._heartbeat.start(received)
            self._absent = None
            return
        if not isinstance(message, wire.Pong | wire.Reply):
            return
        told = Told(message.queue_depth, message.load, message.capacity)
        if isinstance(message, wire.Pong):
            self._heartbeat.answer(message.id, received, told)
            return
        self._heartbeat.hear(received, told)
        if message.id in self._pending:
            if message.status == "need_blob":
                self._send_blobs(self._pending[message.id], message.missing)
            else:
                self._finish_reply(self._pending[message.id], message, received, bytes_in)

    def _send_blobs(self, pending: _Pending, missing: Iterable[bytes]) -> None:
        pending.attempt += 1
        if pending.attempt > ATTEMPTS_MAX or not pending.body.blobs.keys() >= set(missing):
            self._finish(pending.task.id, CloudBroken("the server keeps losing the blobs"), started=False)
            return
        if pending.asks:
            self._uploads.found(pending.task.kind.name, new=True)
            pending.asks = False
        # Another task may have brought one since this one was sent; messages keep their order.
        sent_as = pending.sent_as
        self._upload(pending, [one for one in missing if not self._uploads.carried_after(one, sent_as)])
        self._send_request(pending)

    def _upload(self, pending: _Pending, digests: Iterable[bytes]) -> None:
        for digest in digests:
            pending.bytes_out += self._send(wire.Blob(pending.body.blobs[digest]))
            self._uploads.sent(digest, self._messages)

    def _finish_reply(self, pending: _Pending, reply: wire.Reply, received: float, bytes_in: int) -> None:
        value, failure = None, _failure(reply)
        if pending.asks and reply.status in ("ok", "failed"):
            self._uploads.found(pending.task.kind.name, new=False)
        if failure is None:
            try:
                value = wire.decode(reply.body, pending.task.kind.types, {})
            except ProtocolError as error:
                failure = CloudBroken(f"answer cannot be read: {error}")
        seconds = received - pending.published
        network_s = max(0.0, seconds - reply.queue_s - reply.run_s)
        execution = Execution(
            self.site,
            seconds,
            value,
            failure,
            queue_s=reply.queue_s,
            run_s=reply.run_s,
            network_s=network_s,
            cpu_s=reply.cpu_s,
            bytes_out=pending.bytes_out,
            bytes_in=bytes_in,
            started=reply.status in ("ok", "failed"),
        )
        del self._pending[pending.task.id]
        pending.future.set_result(execution)

    def _expire(self) -> None:
        """Give up what is overdue; say hello again where it was not answered."""
        now = time.perf_counter()
        if self._hello_due <= now:
            self._say_hello()
        for request_id in [id for id, pending in self._pending.items() if pending.deadline <= now]:
            self._send(wire.Cancel(request_id))
            self._finish(request_id, CloudTimeout("no answer within the budget"), censored=True)
            self._heartbeat.hurry(now)

    def _finish(
        self, request_id: int, failure: CloudError, *, censored: bool = False, started: bool = True
    ) -> None:
        """Give a request up."""
        pending = self._pending.pop(request_id)
        pending.future.set_result(
            Execution(
                self.site,
                time.perf_counter() - pending.published,
                failure=failure,
                censored=censored,
                bytes_out=pending.bytes_out,
                started=started,
            )
        )

    def _shut_down(self) -> None:
        self._absent = "closed"
        self._turns.close()
        with self._turns.taken, self._channel.lock:
            for request_id in list(self._pending):
                self._finish(request_id, CloudBroken("closed while the task was in flight"))
            self._socket.disable_monitor()
            self._context.destroy(linger=0)
            self._channel.close()


_FAILURES: dict[str, Callable[[str], OffloadError]] = {
    "failed": TaskFailed,
    "busy": CloudBusy,
    "expired": CloudBusy,
    "unknown_task": CloudBroken,
}


def _failure(reply: wire.Reply) -> OffloadError | None:
    if reply.status == "ok":
        return None
    failure = CloudBroken if reply.server_fault else _FAILURES[reply.status]
    return failure(reply.error or reply.status)


def _connect(
    context: "zmq.Context[Any]", endpoint: str, keys: RobotKeys | None
) -> tuple["zmq.Socket[bytes]", "zmq.Socket[bytes]"]:
    dealer = context.socket(zmq.DEALER)
    dealer.linger = 0
    dealer.ipv6 = "[" in endpoint
    dealer.immediate = True  # a request never waits for a connection: it would arrive with its budget gone
    dealer.sndhwm = dealer.rcvhwm = SEND_QUEUE_MAX
    dealer.reconnect_ivl, dealer.reconnect_ivl_max = RECONNECT_MS, RECONNECT_MAX_MS
    dealer.setsockopt(zmq.TCP_MAXRT, UNACKNOWLEDGED_MS)
    dealer.setsockopt(zmq.TCP_KEEPALIVE, 1)
    dealer.setsockopt(zmq.TCP_KEEPALIVE_IDLE, KEEPALIVE_IDLE_S)
    dealer.setsockopt(zmq.TCP_KEEPALIVE_INTVL, KEEPALIVE_EVERY_S)
    dealer.setsockopt(zmq.TCP_KEEPALIVE_CNT, KEEPALIVE_PROBES)
    dealer.maxmsgsize = MESSAGE_BYTES_MAX
    if keys is not None:
        dealer.curve_publickey, dealer.curve_secretkey = keys.own.public, keys.own.secret
        dealer.curve_serverkey = keys.server
    events = zmq.EVENT_HANDSHAKE_SUCCEEDED | zmq.EVENT_DISCONNECTED
    monitor = dealer.get_monitor_socket(sum(HANDSHAKE_FAILURES, events))
    dealer.connect(endpoint)
    return dealer, monitor


@lru_cache(maxsize=256)  # once for each server, however many offloaders are made
def _warn_of_plain_text(site: str, endpoint: str) -> None:
    if not on_loopback(endpoint.removeprefix("tcp://").rpartition(":")[0].strip("[]")):
        log.warning("%s: %s without keys: whoever is on the way can read and change it", site, endpoint)
