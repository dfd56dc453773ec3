"""The runner of a policy server: it sends observations over a WebSocket, and takes the answers as actions.

What a message looks like is `numpy_msgpack`; how it travels is `web_socket`.
"""

import asyncio
import contextlib
import logging
import math
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial

from offboard.common.errors import (
    BadValue,
    CannotCross,
    CloudBroken,
    CloudBusy,
    CloudTimeout,
    OffloadError,
    Overtaken,
    ProtocolError,
    describe,
)
from offboard.common.tasks import Kind, Task
from offboard.common.wire.channel import check_room
from offboard.common.wire.payload import payload_bytes
from offboard.robot_client.openpi.endpoint import check_policy_server, is_readable
from offboard.robot_client.openpi.numpy_msgpack import ANSWER_BYTES_MAX, pack, unpack
from offboard.robot_client.openpi.observation import Observation, shortened
from offboard.robot_client.openpi.observation_queue import QUEUE_MAX, ObservationQueue
from offboard.robot_client.openpi.web_socket import OPEN_S, WebSocket, open_web_socket
from offboard.robot_client.sites.absence import CrossingPauses
from offboard.robot_client.sites.background import Background
from offboard.robot_client.sites.heartbeat import EARLY_S, Heartbeat, ServerReport
from offboard.robot_client.sites.runner import Condition, Execution, Lasting, Sending

RECONNECT_S, RECONNECT_MAX_S = 0.1, 1.0  # the first pause before the next attempt to connect, and the longest
ABANDONED_MAX_S = 60.0  # for which the answer to a task that was given up keeps the connection
CLOSE_WAIT_S = 2.0
LOG_PAUSE_S = 10.0  # at least, between two warnings about what the server did

log = logging.getLogger(__name__)


class PolicyServerRunner:
    """Runs tasks of kinds with `policy_server` on the server at `endpoint` (ws://HOST:PORT, wss://HOST:PORT).

    The server numbers neither observations nor answers, so one observation is under way at a time, and the
    next one waits. If it is given up, its answer is still due: the site takes no task before that.

    Pings are the heartbeats. Most policy servers compute in the thread that would answer a ping, so no ping
    is sent while an observation is under way, but just before it, if one is due.

    A thread with an event loop owns the connection. `insecure`: allow ws:// beyond this computer.
    """

    def __init__(
        self,
        endpoint: str,
        *,
        site: str,
        heartbeat_s: float = 0.0,
        seed: int = 0,
        insecure: bool = False,
        background: Background | None = None,
    ) -> None:
        check_policy_server(site, endpoint, insecure=insecure)
        if is_readable(endpoint):
            text = "%s: %s: anybody on the way can read and change what is sent; remedy: use wss://"
            log.warning(text, site, endpoint)
        self.site = site
        self._endpoint = endpoint
        self._absent: str | None = f"no answer from {endpoint} yet"
        self._heartbeat = Heartbeat(heartbeat_s, seed, background or Background())
        self._pauses = CrossingPauses()
        self._queue = ObservationQueue()
        self._reconnect_s = RECONNECT_S
        self._warned_s = -math.inf
        self._closed = False
        self._lock = threading.Lock()
        self._changed = asyncio.Event()
        check_room(f"{site}: endpoint {endpoint!r}")
        self._loop = asyncio.new_event_loop()
        self._main = self._loop.create_task(self._serve())
        self._thread = threading.Thread(target=self._run, name=f"site-{site}", daemon=True)
        self._thread.start()

    def unavailable(self, kind: Kind) -> str | None:
        if not kind.policy_server:
            return Lasting(f"a policy server takes only tasks with policy_server=True; {kind.name} is none")
        if self._absent is not None:
            return self._absent
        if self._queue.owed_since_s is not None:
            return "the policy server still computes an answer that came too late"
        return self._pauses.why_absent(kind.name)

    def submit(self, task: Task, budget_s: float) -> "Future[Execution]":
        published_s = time.perf_counter()
        try:
            data = pack(task.args[0])
        except Exception as error:  # noqa: BLE001 - whatever cannot be sent, onboard can answer
            why = str(error) if isinstance(error, BadValue) else describe(error)
            failure = CannotCross(f"observation: {why}")
            self._pauses.note(task.kind.name, failure, published_s)
            return self._refused(failure)
        observation = Observation(
            self.site, task, data, published_s=published_s, deadline_s=published_s + budget_s
        )
        with self._lock:
            if self._closed:
                observation.future.cancel()
                observation.future.set_running_or_notify_cancel()  # or a wait for several would go on
                return observation.future
            if self._queue.full:
                return self._refused(CloudBusy(f"{QUEUE_MAX} observations wait for their answers"))
            self._queue.add(observation)
            self._loop.call_soon_threadsafe(self._begin, observation)
        return observation.future

    def to_send(self, task: Task) -> Sending:
        return Sending(payload_bytes(task.args))

    def cancel(self, task: Task) -> None:
        self._tell(partial(self._overtake, task.id))

    def hurry(self) -> None:
        self._tell(self._hurry)

    def condition(self) -> Condition:
        return self._heartbeat.condition(time.perf_counter())

    def close(self) -> None:
        with self._lock:
            if not self._closed:
                self._closed = True
                self._loop.call_soon_threadsafe(self._main.cancel)
        self._thread.join(CLOSE_WAIT_S)

    def _tell(self, what: Callable[[], None]) -> None:
        with self._lock:
            if not self._closed:
                self._loop.call_soon_threadsafe(what)

    def _refused(self, failure: OffloadError) -> "Future[Execution]":
        future: Future[Execution] = Future()
        future.set_result(Execution(self.site, 0.0, failure=failure, started=False))
        return future

    # What follows runs in the thread of the event loop.

    def _run(self) -> None:
        try:
            with contextlib.suppress(asyncio.CancelledError):
                self._loop.run_until_complete(self._main)
        finally:
            with self._lock:
                self._closed = True
            self._down("closed", "closed while the task was in flight")
            self._loop.run_until_complete(self._loop.shutdown_asyncgens())
            self._loop.close()

    async def _serve(self) -> None:
        """Connect, and connect again after each connection, until `close`."""
        while True:
            try:
                async with open_web_socket(self._endpoint, ANSWER_BYTES_MAX) as socket:
                    await self._greet(socket)
                    await self._converse(socket)
            except (CloudBroken, ProtocolError) as error:
                why = str(error)
                if isinstance(error, ProtocolError) or not self._queue.idle:
                    self._warn(why)
                elif self._absent is None:  # some servers end a connection that is not used for a while
                    log.info("%s: connection to %s lost: %s", self.site, self._endpoint, why)
            except Exception as error:
                why = describe(error)
                log.exception("%s: %s; remedy: report this traceback", self.site, self._endpoint)
            self._down(f"not connected to {self._endpoint}: {why}", f"the connection was lost: {why}")
            await asyncio.sleep(self._reconnect_s)
            self._reconnect_s = min(2 * self._reconnect_s, RECONNECT_MAX_S)

    async def _greet(self, socket: WebSocket) -> None:
        """Wait for the metadata of the server, its first message."""
        try:
            async with asyncio.timeout(OPEN_S):
                metadata = await socket.receive()
        except TimeoutError as error:
            raise CloudBroken("it sends no metadata") from error
        if isinstance(metadata, str):
            raise ProtocolError(f"the server says: {shortened(metadata)}")
        if not isinstance(unpack(metadata), dict):
            raise ProtocolError("the first message of the server is no metadata")
        log.info("%s: %s is up", self.site, self._endpoint)
        self._heartbeat.start(time.perf_counter())
        self._absent = None

    async def _converse(self, socket: WebSocket) -> None:
        """Send and receive until the connection ends, which raises its reason."""
        parts = [asyncio.create_task(part) for part in (self._send_all(socket), self._receive_all(socket))]
        try:
            ended, _ = await asyncio.wait(parts, return_when=asyncio.FIRST_COMPLETED)
            for part in ended:
                part.result()
        finally:
            for part in parts:
                part.cancel()
            await asyncio.gather(*parts, return_exceptions=True)

    async def _receive_all(self, socket: WebSocket) -> None:
        while True:
            message = await socket.receive()
            self._take(message, time.perf_counter())

    async def _send_all(self, socket: WebSocket) -> None:
        while True:
            self._changed.clear()
            if self._queue.idle:
                await self._beat(socket)
                await self._send_next(socket)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(self._rest_s()):
                    await self._changed.wait()

    async def _send_next(self, socket: WebSocket) -> None:
        """Send the observation whose turn it is. CloudBroken if the server does not take all of it."""
        now_s = time.perf_counter()
        if (observation := self._queue.send_next(now_s)) is None:
            return
        try:
            async with asyncio.timeout(observation.deadline_s - now_s + ABANDONED_MAX_S):
                await socket.send(observation.data)
        except TimeoutError as error:
            raise CloudBroken("it does not take the observation") from error

    async def _beat(self, socket: WebSocket) -> None:
        now_s = time.perf_counter()
        early_s = EARLY_S if self._queue.waits else 0.0
        if self._heartbeat.due_s <= now_s + early_s:
            await socket.ping(partial(self._pong, self._heartbeat.beat(now_s)))

    def _rest_s(self) -> float | None:
        """How long nothing is due; None: until something changes. CloudBroken if an answer is overdue."""
        now_s, owed_since_s = time.perf_counter(), self._queue.owed_since_s
        if self._queue.idle:
            return None if math.isinf(self._heartbeat.due_s) else self._heartbeat.due_s - now_s
        if owed_since_s is None:
            return None
        left_s = owed_since_s + ABANDONED_MAX_S - now_s
        if left_s <= 0:
            raise CloudBroken(f"it has not answered for {ABANDONED_MAX_S:g} s")
        return left_s

    def _begin(self, observation: Observation) -> None:
        if self._queue.find(observation.task.id) is None:
            return  # given up with the connection
        if self._absent is not None:
            self._queue.give_up(observation, CloudBroken(self._absent), time.perf_counter())
            return
        left_s = max(0.0, observation.deadline_s - time.perf_counter())
        observation.timer = self._loop.call_later(left_s, self._expire, observation)
        self._queue.line_up(observation)
        self._changed.set()

    def _take(self, message: bytes | str, now_s: float) -> None:
        self._heartbeat.hear(now_s, ServerReport())
        observation = self._queue.take_answered()
        self._changed.set()
        if observation is None:
            raise ProtocolError("the server sent a message that no observation asked for")
        if observation.given_up:
            return
        execution = observation.answered(message, now_s)
        bad = None
        if execution.failure is None:
            self._reconnect_s = RECONNECT_S
        else:  # a server whose answers are bad is left out for a while
            why = str(execution.failure)
            self._warn(why)
            bad = CannotCross(why)
        self._pauses.note(observation.task.kind.name, bad, now_s)
        self._queue.end(observation, execution)

    def _pong(self, number: int) -> None:
        self._heartbeat.answer(number, time.perf_counter(), ServerReport())
        self._changed.set()

    def _hurry(self) -> None:
        self._heartbeat.hurry(time.perf_counter())
        self._changed.set()

    def _expire(self, observation: Observation) -> None:
        failure = CloudTimeout("no answer within the budget")
        self._queue.give_up(observation, failure, time.perf_counter(), censored=True)
        self._hurry()

    def _overtake(self, task_id: int) -> None:
        observation = self._queue.find(task_id)
        if observation is not None:
            failure = Overtaken("another site answered first")
            self._queue.give_up(observation, failure, time.perf_counter(), censored=True)
            self._hurry()

    def _down(self, absent: str, failure: str) -> None:
        """There is no connection: give up what was not answered."""
        self._absent = absent
        self._heartbeat.stop()
        self._queue.give_up_all(CloudBroken(failure), time.perf_counter())

    def _warn(self, why: str) -> None:
        now_s = time.perf_counter()
        if now_s - self._warned_s >= LOG_PAUSE_S:
            self._warned_s = now_s
            text = "%s: %s: %s (others within %g s are not logged); remedy: see the log of that server"
            log.warning(text, self.site, self._endpoint, why, LOG_PAUSE_S)
