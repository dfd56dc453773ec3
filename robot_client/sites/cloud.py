"""The runner of a remote site: it sends tasks to one server, and matches the answers by id.

What a message looks like is `wire.messages`; which thread reads the socket is `shared_reader`; whether the
server can be used is `connection`.
"""

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Iterable
from concurrent.futures import Future

from offboard.common import VERSION as SOFTWARE
from offboard.common.errors import (
    BadValue,
    CannotCross,
    CloudBroken,
    CloudBusy,
    CloudError,
    CloudTimeout,
    OffloadError,
    Overtaken,
    ProtocolError,
    SiteClosed,
    describe,
)
from offboard.common.security.keys import RobotKeys
from offboard.common.source.comparison import difference
from offboard.common.source.reading import is_reading
from offboard.common.tasks import Kind, Task, hashes
from offboard.common.wire import messages as wire
from offboard.common.wire.compression import compressions
from offboard.common.wire.payload import payload_bytes
from offboard.robot_client.sites.absence import CrossingPauses
from offboard.robot_client.sites.background import Background
from offboard.robot_client.sites.blob_uploads import BlobUploads
from offboard.robot_client.sites.cloud_socket import MESSAGE_BYTES_MAX, CloudSocket, SocketEvent
from offboard.robot_client.sites.connection import LOG_PAUSE_S, Action, Connection, HandshakeFailure
from offboard.robot_client.sites.heartbeat import EARLY_S, Heartbeat, ServerReport
from offboard.robot_client.sites.outgoing import Outgoing
from offboard.robot_client.sites.pending_request import PendingRequest
from offboard.robot_client.sites.runner import CLOUD, Condition, Execution, Lasting, Sending, check_endpoint
from offboard.robot_client.sites.shared_reader import Answer, SharedReader

PENDING_MAX = 1024
ATTEMPTS_MAX = 4  # sends of one request: the first, and one after each `need_blob`
CLOSE_WAIT_S = 2.0
CANCEL_LINGER_MS = 200  # for the cancels of a close to leave
IDLE_WAIT_S = 1.0
READ_MAX = 100  # messages read at once: a server that floods the robot must not keep tasks waiting

log = logging.getLogger(__name__)


class CloudRunner:
    """Runs tasks on the server at `endpoint` (tcp://HOST:PORT).

    The site is available for a kind once the server has answered `hello` on the present connection with
    the same protocol version and the same source for that kind, or for the variant of this site.

    heartbeat_s: seconds between heartbeats; 0: none are sent, and only tasks are measured.
    keys: encrypt the connection, and connect only to the server of this key.
    compress: whether arguments may be compressed for this server.
    """

    def __init__(
        self,
        endpoint: str,
        *,
        site: str = CLOUD,
        heartbeat_s: float = 0.0,
        seed: int = 0,
        keys: RobotKeys | None = None,
        background: Background | None = None,
        compress: bool = True,
    ) -> None:
        check_endpoint(site, endpoint)
        self.site = site
        self._connection = Connection(site, endpoint)
        background = background or Background()
        self._heartbeat = Heartbeat(heartbeat_s, seed, background)
        self._heartbeat_wanted = False  # by `hurry`
        self._remote: dict[str, str] = {}  # source hashes at the server, by kind and variant
        self._remote_software = SOFTWARE
        self._message_bytes_max = MESSAGE_BYTES_MAX  # what the server takes, once it has said so
        self._compressions = set(compressions() if compress else ())
        self._compresses = False  # whether the server takes what one of them makes
        self._warned: set[str] = set()  # kinds
        self._pending: dict[int, PendingRequest] = {}
        self._cancelled: deque[int] = deque()
        self._socket = CloudSocket(site, endpoint, keys)
        self._reader = SharedReader(
            self._tend,
            self._receive,
            unanswered=self._pending.__len__,
            expects_message=self._expects_message,
            wake=self._socket.wake,
            pause_s=background.pause_s,
        )
        self._reader_wakes_s: float | None = None  # when a waiting reader wakes by itself; None: none waits
        self._messages = 0
        self._warned_s = -math.inf  # when a bad message was last logged
        self._uploads = BlobUploads()
        self._pauses = CrossingPauses()
        self._thread = threading.Thread(target=self._run, name=f"site-{site}", daemon=True)
        try:
            self._thread.start()
        except RuntimeError as error:
            self._socket.close()
            raise OffloadError(f"{site}: {error}") from error

    def unavailable(self, kind: Kind) -> str | None:
        absent = self._connection.why_absent
        if absent is not None:
            return absent
        why = difference(kind, self.site, self._remote, self._remote_software)
        if why is None:
            return self._pauses.why_absent(kind.name)
        if is_reading(kind):
            return why
        if kind.name not in self._warned:
            self._warned.add(kind.name)
            text = "%s: %s: this task stays onboard; remedy: install the same version there, and restart it"
            log.warning(text, self.site, why)
        return Lasting(why)

    def submit(self, task: Task, budget_s: float) -> "Future[Execution]":
        published_s = time.perf_counter()
        try:
            inline = self._uploads.inline_rule(task.kind.name, self._message_bytes_max)
            outgoing = Outgoing(task, inline, compresses=self._compresses)
            values = outgoing.values(task, self._uploads.probably_carried)
            body = wire.encode(
                values,
                task.kind.types,
                name="arguments",
                blobs=True,
                along=outgoing,
                array_bytes_max=self._message_bytes_max,
            )
        except Exception as error:  # noqa: BLE001 - whatever cannot be sent, onboard can answer
            why = str(error) if isinstance(error, BadValue) else f"arguments: {describe(error)}"
            return self._cannot_cross(task, why)
        largest = max([wire.byte_count(body.frames), *(raw.nbytes for raw in body.blobs.values())])
        if largest > self._message_bytes_max - wire.HEADER_BYTES_MAX:
            why = f"arguments of {largest} bytes; the server takes messages of {self._message_bytes_max}"
            return self._cannot_cross(task, why)
        if len(self._pending) >= PENDING_MAX:
            return self._refused(CloudBusy(f"{PENDING_MAX} tasks are in flight"))
        pending = PendingRequest(
            self.site,
            task,
            body,
            published_s,
            deadline_s=published_s + budget_s,
            future=Answer(self._reader),
            outgoing=outgoing,
        )
        with self._socket.lock:
            if self._reader.closed:
                pending.future.cancel()
                pending.future.set_running_or_notify_cancel()  # or a wait for several futures would go on
                return pending.future
            self._pending[task.id] = pending
            self._beat(early_s=EARLY_S)
            self._send_first(pending)
            if self._reader_wakes_s is not None and pending.deadline_s < self._reader_wakes_s:
                self._socket.wake()
        return pending.future

    def to_send(self, task: Task) -> Sending:
        if task.kind.pack is not None:
            return Sending(payload_bytes(task.args))
        known = self._uploads.probably_carried
        count = payload_bytes(task.args, known)
        if count <= wire.BLOB_BYTES_MIN or not self._compresses:
            return Sending(count)
        sizes = [(number, payload_bytes(one, known)) for number, one in enumerate(task.args)]
        return Sending(count, tuple(one for one in sizes if one[1] > wire.BLOB_BYTES_MIN))

    def cancel(self, task: Task) -> None:
        self._cancelled.append(task.id)
        self._reader.interrupt()

    def hurry(self) -> None:
        self._heartbeat_wanted = True
        self._reader.interrupt()

    def condition(self) -> Condition:
        return self._heartbeat.condition(time.perf_counter())

    def close(self) -> None:
        self._reader.close()
        self._thread.join(CLOSE_WAIT_S)

    def _cannot_cross(self, task: Task, why: str) -> "Future[Execution]":
        failure = CannotCross(why)
        self._pauses.note(task.kind.name, failure, time.perf_counter())
        return self._refused(failure)

    def _refused(self, failure: OffloadError) -> "Future[Execution]":
        future: Future[Execution] = Future()
        future.set_result(Execution(self.site, 0.0, failure=failure, started=False))
        return future

    def _expects_message(self) -> bool:
        return bool(self._pending or self._heartbeat.unanswered)

    def _run(self) -> None:
        try:
            self._reader.run(IDLE_WAIT_S)
        finally:
            self._shut_down()

    # The thread that has the turn calls what follows. Only `submit` sends from another thread.

    def _tend(self) -> None:
        """Do what is due."""
        with self._socket.lock:
            self._follow_connection()
            while self._cancelled:
                self._cancel(self._cancelled.popleft())
            self._expire()
            self._beat()

    def _receive(self, wait_s: float) -> None:
        with self._socket.lock:
            now_s = time.perf_counter()
            deadlines = [pending.deadline_s for pending in self._pending.values()]
            wakes_s = min([now_s + wait_s, self._connection.due_s, self._heartbeat.due_s, *deadlines])
            self._reader_wakes_s = wakes_s
        self._socket.wait(wakes_s - now_s)
        with self._socket.lock:
            self._reader_wakes_s = None
            for _ in range(READ_MAX):
                if (frames := self._socket.receive()) is None:
                    break
                self._read([frame.buffer for frame in frames], time.perf_counter())
                if not self._expects_message():
                    break

    def _follow_connection(self) -> None:
        for event in self._socket.events():
            now_s = time.perf_counter()
            match event:
                case SocketEvent.HANDSHAKE_SUCCEEDED:
                    self._connection.handshake_succeeded(now_s)
                case HandshakeFailure():
                    self._connection.handshake_failed(event, now_s)
                case SocketEvent.DISCONNECTED:
                    self._connection.disconnected(now_s)
                    self._heartbeat.stop()
                    self._uploads.forget()
                    for request_id in list(self._pending):
                        self._give_up(request_id, CloudBroken("the connection was lost"))
        match self._connection.take_due(time.perf_counter()):
            case Action.SAY_HELLO:
                self._send(wire.Hello(hashes(), SOFTWARE, MESSAGE_BYTES_MAX))
            case Action.CONNECT_AGAIN:
                self._socket.connect_again()

    def _cancel(self, request_id: int) -> None:
        if request_id in self._pending:
            self._send(wire.Cancel(request_id))
            self._give_up(request_id, Overtaken("another site answered first"), censored=True)
            self._heartbeat.hurry(time.perf_counter())

    def _expire(self) -> None:
        """Give up the requests whose budget is over."""
        now_s = time.perf_counter()
        for request_id in [id for id, pending in self._pending.items() if pending.deadline_s <= now_s]:
            self._send(wire.Cancel(request_id))
            self._give_up(request_id, CloudTimeout("no answer within the budget"), censored=True)
            self._heartbeat.hurry(now_s)

    def _beat(self, early_s: float = 0.0) -> None:
        now_s = time.perf_counter()
        if self._heartbeat_wanted:
            self._heartbeat_wanted = False
            self._heartbeat.hurry(now_s)
        if self._heartbeat.due_s <= now_s + early_s:
            self._send(wire.Ping(self._heartbeat.beat(now_s)))

    def _send_first(self, pending: PendingRequest) -> None:
        """Send a request for the first time.

        Blobs of a kind whose arguments are always new are uploaded first; others are only named.
        """
        body, kind = pending.body, pending.task.kind.name
        unknown = self._uploads.unknown(body)
        if unknown and self._uploads.often_new(kind):
            self._upload(pending, unknown)
        elif unknown:
            pending.doubtful = True
        elif body.blobs and not pending.outgoing.inline.used:
            self._uploads.found(kind, new=False)
        self._send_request(pending)

    def _send_request(self, pending: PendingRequest) -> None:
        now_s = time.perf_counter()
        if pending.deadline_s > now_s:
            sent = self._send(pending.message(now_s))
            pending.bytes_out += sent
            pending.last_message = self._messages
            if not sent:
                self._give_up(pending.task.id, CloudBroken("nothing can be sent"), started=False)

    def _send(self, message: wire.Message) -> int:
        """Send a message; return its bytes, 0 if it cannot be sent now."""
        frames = wire.pack(message)
        if not self._socket.try_send(frames):
            return 0
        self._messages += 1
        return wire.byte_count(frames)

    def _read(self, frames: list[wire.Buffer], received_s: float) -> None:
        try:
            self._take(wire.unpack(frames), received_s, wire.byte_count(frames))
        except wire.VersionMismatch as error:
            self._connection.other_version(str(error), received_s)
        except ProtocolError as error:
            if received_s - self._warned_s >= LOG_PAUSE_S:
                self._warned_s = received_s
                text = (
                    "%s: message dropped: %s (others within %g s are not logged); remedy: robot-client check"
                )
                log.warning(text, self.site, error, LOG_PAUSE_S)

    def _take(self, message: wire.Message, received_s: float, bytes_in: int) -> None:
        if isinstance(message, wire.Hello):
            self._remote, self._remote_software = message.tasks, message.software
            self._message_bytes_max = message.message_bytes_max
            self._compresses = not self._compressions.isdisjoint(message.compressions)
            if self._connection.hello_answered(received_s):
                self._heartbeat.start(received_s)
            return
        if not isinstance(message, wire.Pong | wire.Reply):
            return
        report = ServerReport(message.queue_depth, message.load, message.capacity)
        if isinstance(message, wire.Pong):
            self._heartbeat.answer(message.id, received_s, report)
            return
        self._heartbeat.hear(received_s, report)
        pending = self._pending.get(message.id)
        if pending is None:
            return  # the request was given up
        if message.status == "need_blob":
            self._send_blobs(pending, message.missing)
        else:
            if pending.doubtful and message.status in ("ok", "failed"):
                self._uploads.found(pending.task.kind.name, new=False)
            execution = pending.answered(message, received_s, bytes_in)
            self._pauses.note(pending.task.kind.name, execution.failure, received_s)
            del self._pending[message.id]
            pending.future.set_result(execution)

    def _send_blobs(self, pending: PendingRequest, missing: Iterable[bytes]) -> None:
        """Upload the blobs that the server lacks, and send the request again."""
        pending.attempt += 1
        if pending.attempt > ATTEMPTS_MAX or not pending.body.blobs.keys() >= set(missing):
            failure = CloudBroken("the server keeps losing the blobs")
            self._give_up(pending.task.id, failure, started=False)
            return
        if pending.doubtful:
            self._uploads.found(pending.task.kind.name, new=True)
            pending.doubtful = False
        # Messages keep their order: a blob that another task sent after this request is there by now.
        sent_before = pending.last_message
        lost = [digest for digest in missing if not self._uploads.carried_after(digest, sent_before)]
        self._upload(pending, lost)
        self._send_request(pending)

    def _upload(self, pending: PendingRequest, digests: Iterable[bytes]) -> None:
        for digest in digests:
            raw = pending.body.blobs[digest]
            data = pending.outgoing.smaller(pending.body.arguments[digest], raw)
            pending.bytes_out += self._send(wire.Blob(data, None if data is raw else raw.nbytes))
            self._uploads.sent(digest, self._messages)

    def _give_up(
        self, request_id: int, failure: CloudError, *, censored: bool = False, started: bool = True
    ) -> None:
        pending = self._pending.pop(request_id)
        pending.future.set_result(
            pending.given_up(failure, time.perf_counter(), censored=censored, started=started)
        )

    def _shut_down(self) -> None:
        self._connection.close()
        self._reader.close()
        with self._reader.turn, self._socket.lock:
            cancelled = list(
                reversed(self._pending)
            )  # the last first: no place is free before it is cancelled
            for request_id in cancelled:
                self._send(wire.Cancel(request_id))
                self._give_up(request_id, SiteClosed("closed while the task was in flight"))
            self._socket.close(CANCEL_LINGER_MS if cancelled else 0)
