"""The runner of a remote site: it sends tasks to one server, and matches the answers by id.

What a message looks like is `wire.messages`; which thread reads the socket is `waiting`; whether the
server can be used is `connection`.
"""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future
from functools import partial

from offboard.common import VERSION as SOFTWARE
from offboard.common.errors import BadValue, CloudBroken, OffloadError, ProtocolError, describe
from offboard.common.logs import RareLog
from offboard.common.security.keys import RobotKeys
from offboard.common.source.comparison import difference, is_reading
from offboard.common.tasks import Kind, Task, hashes
from offboard.common.wire import messages as wire
from offboard.common.wire.compression import compressions
from offboard.common.wire.payload import payload_bytes
from offboard.robot_client.cloud.cloud_socket import MESSAGE_BYTES_MAX, CloudSocket, SocketEvent
from offboard.robot_client.cloud.connection import Action, Connection, HandshakeFailure
from offboard.robot_client.cloud.wire_request import WireRequest
from offboard.robot_client.sites.absence import CrossingPauses, SiteView
from offboard.robot_client.sites.conversation import (
    NOT_SENT,
    Cancel,
    Conversation,
    Finish,
    Instructions,
    Ping,
    Send,
)
from offboard.robot_client.sites.endpoint import check_endpoint
from offboard.robot_client.sites.heartbeat import Background, Heartbeat, ServerReport
from offboard.robot_client.sites.outgoing import BlobUploads, Outgoing
from offboard.robot_client.sites.runner import CLOUD, Condition, Execution, Lasting, Sending
from offboard.robot_client.sites.waiting import Answer, SharedReader

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
        self._endpoint = endpoint
        self._connection = Connection(site, endpoint)
        background = background or Background()
        self._conversation = Conversation(Heartbeat(heartbeat_s, seed, background))
        self._server = wire.Hello({}, SOFTWARE, MESSAGE_BYTES_MAX)  # its last `hello`
        self._compressions = set(compressions() if compress else ())
        self._compresses = False  # whether the server takes what one of them makes
        self._warned: set[str] = set()  # kinds
        self._events: deque[Callable[[float], Instructions]] = deque()  # of other threads
        self._socket = CloudSocket(site, endpoint, keys)
        self._reader = SharedReader(
            self._tend,
            self._receive,
            unanswered=lambda: self._conversation.in_flight,
            expects_message=self._conversation.expects_message,
            wake=self._socket.wake,
            pause_s=background.pause_s,
        )
        self._reader_wakes_s: float | None = None  # when a waiting reader wakes by itself; None: none waits
        self._messages = 0
        self._log = RareLog(log, f"{site}: ")
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
        why = difference(kind, self.site, self._server.tasks, self._server.software)
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
        published_s, bytes_max = time.perf_counter(), self._server.message_bytes_max
        try:
            inline = self._uploads.inline_rule(task.kind.name, bytes_max)
            outgoing = Outgoing(task, inline, compresses=self._compresses)
            values = outgoing.values(task, self._uploads.probably_carried)
            body = wire.encode(
                values,
                task.kind.types,
                name="arguments",
                blobs=True,
                along=outgoing,
                array_bytes_max=bytes_max,
            )
        except Exception as error:  # noqa: BLE001 - whatever cannot be sent, onboard can answer
            why = str(error) if isinstance(error, BadValue) else f"arguments: {describe(error)}"
            return self._pauses.refuse(self.site, task.kind.name, why)
        together = (task.kind.at(self.site) if task.kind.variants else task.kind).together
        try:
            key = "" if together is None else together.key_of(task.args)
        except BadValue as error:
            return self._pauses.refuse(self.site, task.kind.name, str(error))
        largest = max([wire.byte_count(body.frames), *(raw.nbytes for raw in body.blobs.values())])
        if largest > bytes_max - wire.HEADER_BYTES_MAX:
            why = f"arguments of {largest} bytes; the server takes messages of {bytes_max}"
            return self._pauses.refuse(self.site, task.kind.name, why)
        request = WireRequest(
            site=self.site,
            task=task,
            published_s=published_s,
            deadline_s=published_s + budget_s,
            future=Answer(self._reader),
            body=body,
            outgoing=outgoing,
            key=key,
        )
        with self._socket.lock:
            if self._conversation.closed or self._reader.closed:
                request.future.cancel()
                request.future.set_running_or_notify_cancel()  # or a wait for several futures would go on
                return request.future
            self._do(self._conversation.submit(request, time.perf_counter()))
            if self._reader_wakes_s is not None and request.deadline_s < self._reader_wakes_s:
                self._socket.wake()
        return request.future

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
        self._events.append(partial(self._conversation.cancel, task.id))
        self._reader.interrupt()

    def hurry(self) -> None:
        self._events.append(self._conversation.hurry)
        self._reader.interrupt()

    def condition(self) -> Condition:
        return self._conversation.condition(time.perf_counter())

    def look(self) -> SiteView:
        why_absent, story = self._connection.why_absent, self._conversation.story
        return SiteView(self._endpoint, why_absent is None, why_absent, story=story)

    def close(self) -> None:
        self._reader.close()
        self._thread.join(CLOSE_WAIT_S)

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
            now_s = time.perf_counter()
            while self._events:
                self._do(self._events.popleft()(now_s))
            self._do(self._conversation.time(now_s))

    def _receive(self, wait_s: float) -> None:
        with self._socket.lock:
            now_s = time.perf_counter()
            wakes_s = min(now_s + wait_s, self._connection.due_s, self._conversation.wakes_s)
            self._reader_wakes_s = wakes_s
        self._socket.wait(wakes_s - now_s)
        with self._socket.lock:
            self._reader_wakes_s = None
            for _ in range(READ_MAX):
                if (frames := self._socket.receive()) is None:
                    break
                self._read([frame.buffer for frame in frames], time.perf_counter())
                if not self._conversation.expects_message():
                    break

    def _do(self, instructions: Instructions) -> None:
        for one in instructions:
            if isinstance(one, Finish):
                one.request.future.set_result(one.execution)
            elif isinstance(one, Send) and isinstance(one.request, WireRequest):
                self._send_first(one.request)
            elif isinstance(one, Ping):
                self._send(wire.Ping(one.number))
            elif isinstance(one, Cancel):
                self._send(wire.Cancel(one.request.task.id))

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
                    self._uploads.forget()
                    self._do(self._conversation.down("the connection was lost", now_s))
        match self._connection.take_due(time.perf_counter()):
            case Action.SAY_HELLO:
                self._send(wire.Hello(hashes(), SOFTWARE, MESSAGE_BYTES_MAX))
            case Action.CONNECT_AGAIN:
                self._socket.connect_again()

    def _send_first(self, request: WireRequest) -> None:
        """Send a request for the first time.

        Blobs of a kind whose arguments are always new are uploaded first; others are only named.
        """
        body, kind = request.body, request.task.kind.name
        unknown = self._uploads.unknown(body)
        if unknown and self._uploads.often_new(kind):
            self._upload(request, unknown)
        elif unknown:
            request.doubtful = True
        elif body.blobs and not request.outgoing.inline.used:
            self._uploads.found(kind, new=False)
        self._send_request(request)

    def _send_request(self, request: WireRequest) -> None:
        now_s = time.perf_counter()
        if request.deadline_s > now_s:
            sent = self._send(request.message(now_s))
            request.bytes_out += sent
            request.last_message = self._messages
            if not sent:
                self._do([self._conversation.fail(request, CloudBroken(NOT_SENT), now_s, started=False)])

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
            text = f"message dropped: {error}; remedy: robot-client check"
            self._log(logging.WARNING, text, received_s)

    def _take(self, message: wire.Message, received_s: float, bytes_in: int) -> None:
        if isinstance(message, wire.Hello):
            self._server = message
            self._compresses = not self._compressions.isdisjoint(message.compressions)
            if self._connection.hello_answered(received_s):
                self._conversation.up(received_s)
            return
        if not isinstance(message, wire.Pong | wire.Reply):
            return
        report = ServerReport(message.queue_depth, message.load, message.capacity, message.waits_s)
        if isinstance(message, wire.Pong):
            self._conversation.pong(message.id, received_s, report)
            return
        self._conversation.heard(received_s, report)
        request = self._conversation.asked(message.id)
        if not isinstance(request, WireRequest):
            return  # it was given up
        if message.status == "need_blob":
            self._send_blobs(request, message.missing)
        else:
            if request.doubtful and message.status in ("ok", "failed"):
                self._uploads.found(request.task.kind.name, new=False)
            execution = request.answered(message, received_s, bytes_in)
            self._pauses.note(request.task.kind.name, execution.failure, received_s)
            self._do([self._conversation.answered(request, execution, received_s)])

    def _send_blobs(self, request: WireRequest, missing: Iterable[bytes]) -> None:
        """Upload the blobs that the server lacks, and send the request again."""
        request.attempt += 1
        if request.attempt > ATTEMPTS_MAX or not request.body.blobs.keys() >= set(missing):
            failure = CloudBroken("the server keeps losing the blobs")
            self._do([self._conversation.fail(request, failure, time.perf_counter(), started=False)])
            return
        if request.doubtful:
            self._uploads.found(request.task.kind.name, new=True)
            request.doubtful = False
        # Messages keep their order: a blob that another task sent after this request is there by now.
        sent_before = request.last_message
        lost = [digest for digest in missing if not self._uploads.carried_after(digest, sent_before)]
        self._upload(request, lost)
        self._send_request(request)

    def _upload(self, request: WireRequest, digests: Iterable[bytes]) -> None:
        for digest in digests:
            raw = request.body.blobs[digest]
            data = request.outgoing.smaller(request.body.arguments[digest], raw)
            request.bytes_out += self._send(wire.Blob(data, None if data is raw else raw.nbytes))
            self._uploads.sent(digest, self._messages)

    def _shut_down(self) -> None:
        self._connection.close()
        self._reader.close()
        with self._reader.turn, self._socket.lock:
            ended = self._conversation.close(time.perf_counter())
            self._do(ended)
            self._socket.close(CANCEL_LINGER_MS if ended else 0)
