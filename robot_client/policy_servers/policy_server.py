"""The runner of a policy server: it sends observations, and takes the answers as actions.

What a message looks like and how it travels is up to the protocol: `openpi` or `groot`.
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
from typing import Any

from offboard.common.errors import BadValue, CannotCross, CloudBroken, ProtocolError, describe
from offboard.common.logs import RareLog
from offboard.common.tasks import Kind, Task
from offboard.common.wire.channel import check_room
from offboard.common.wire.payload import payload_bytes
from offboard.robot_client.policy_servers.converted import Convert, Converted
from offboard.robot_client.policy_servers.groot import GROOT, Groot
from offboard.robot_client.policy_servers.openpi import OpenPi
from offboard.robot_client.policy_servers.protocol import Channel, Observation, PolicyProtocol, Raw
from offboard.robot_client.sites.absence import CrossingPauses, SiteView
from offboard.robot_client.sites.conversation import Conversation, Finish, Instructions, Ping, Reconnect, Send
from offboard.robot_client.sites.endpoint import check_policy_server, is_readable
from offboard.robot_client.sites.heartbeat import Background, Heartbeat, ServerReport
from offboard.robot_client.sites.runner import Condition, Execution, Lasting, Sending

RECONNECT_S, RECONNECT_MAX_S = 0.1, 1.0  # the first pause before the next attempt to connect, and the longest
CLOSE_WAIT_S = 2.0

log = logging.getLogger(__name__)


class PolicyServerRunner:
    """Runs tasks of kinds with `policy_server` on the server at `endpoint`, as `check_policy_server` allows.

    The server numbers neither observations nor answers, so one observation is under way at a time, and the
    next one waits. If it is given up, its answer is still due: the site takes no task before that.

    Pings are the heartbeats. Most policy servers compute in the thread that would answer a ping, so no ping
    is sent while an observation is under way, but just before it, if one is due.

    A thread with an event loop owns the connection. `insecure`: allow plain connections beyond this computer.
    `token`: what the server wants to see. `convert`: for a server that wants other
    observations. `metadata`: what it says about itself.
    """

    def __init__(
        self,
        endpoint: str,
        *,
        site: str,
        heartbeat_s: float = 0.0,
        seed: int = 0,
        insecure: bool = False,
        token: str | None = None,
        convert: Convert | None = None,
        background: Background | None = None,
    ) -> None:
        check_policy_server(site, endpoint, insecure=insecure)
        if is_readable(endpoint):
            text = "%s: %s: anybody on the way can read and change what is sent; remedy: use wss://"
            log.warning(text, site, endpoint)
        if token is not None and not endpoint.startswith("wss://"):
            log.warning(
                "%s: %s: its token is sent over a plain connection; remedy: use wss://", site, endpoint
            )
        protocol = protocol_of(endpoint, token)
        self._protocol = protocol if convert is None else Converted(protocol, convert)
        self.metadata: dict[Any, Any] = {}
        self.site = site
        self._endpoint = endpoint
        self._absent: str | None = f"no answer from {endpoint} yet"
        self._conversation = Conversation(Heartbeat(heartbeat_s, seed, background), in_turn=True)
        self._pauses = CrossingPauses()
        self._timer: asyncio.TimerHandle | None = None
        self._reconnect_s = RECONNECT_S
        self._log = RareLog(log, f"{site}: {endpoint}: ")
        self._closed = False
        self._lock = threading.Lock()
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
        if self._conversation.owes:
            return "the policy server still computes an answer that came too late"
        return self._pauses.why_absent(kind.name)

    def submit(self, task: Task, budget_s: float) -> "Future[Execution]":
        published_s = time.perf_counter()
        item = task.args[0]
        try:
            raw = item if isinstance(item, Raw) else None
            data = self._protocol.pack(item) if raw is None else self._protocol.forward(raw)
        except Exception as error:  # noqa: BLE001 - whatever cannot be sent, onboard can answer
            why = str(error) if isinstance(error, BadValue) else describe(error)
            return self._pauses.refuse(self.site, task.kind.name, f"observation: {why}")
        observation = Observation(
            site=self.site,
            task=task,
            protocol=self._protocol,
            data=data,
            raw=raw,
            published_s=published_s,
            deadline_s=published_s + budget_s,
        )
        if not self._tell(partial(self._event, partial(self._conversation.submit, observation))):
            observation.future.cancel()
            observation.future.set_running_or_notify_cancel()  # or a wait for several would go on
        return observation.future

    def to_send(self, task: Task) -> Sending:
        return Sending(payload_bytes(task.args))

    def cancel(self, task: Task) -> None:
        self._tell(partial(self._event, partial(self._conversation.cancel, task.id)))

    def hurry(self) -> None:
        self._tell(partial(self._event, self._conversation.hurry))

    def condition(self) -> Condition:
        return self._conversation.condition(time.perf_counter())

    def look(self) -> SiteView:
        story, absent = self._conversation.story, self._absent
        return SiteView(self._endpoint, absent is None, absent, story=story, metadata=self.metadata)

    def close(self) -> None:
        with self._lock:
            if not self._closed:
                self._closed = True
                self._loop.call_soon_threadsafe(self._main.cancel)
        self._thread.join(CLOSE_WAIT_S)

    def _tell(self, what: Callable[[], None]) -> bool:
        """Do this in the thread of the event loop; false after `close`."""
        with self._lock:
            if not self._closed:
                self._loop.call_soon_threadsafe(what)
            return not self._closed

    # What follows runs in the thread of the event loop.

    def _run(self) -> None:
        try:
            with contextlib.suppress(asyncio.CancelledError):
                self._loop.run_until_complete(self._main)
        finally:
            with self._lock:
                self._closed = True
            self._absent = "closed"
            self._event(self._conversation.close)
            self._loop.run_until_complete(self._loop.shutdown_asyncgens())
            self._loop.close()

    async def _serve(self) -> None:
        """Connect, and connect again after each connection, until `close`."""
        while not self._closed:
            try:
                async with self._protocol.open() as channel:
                    self.metadata = await self._protocol.greet(channel)
                    self._begin()
                    await self._converse(channel)
            except (CloudBroken, ProtocolError) as error:
                why = str(error)
                asked = self._conversation.in_flight or self._conversation.owes
                if asked or isinstance(error, ProtocolError):
                    self._warn(why)
                elif self._absent is None:  # some servers end a connection that is not used for a while
                    log.info("%s: connection to %s lost: %s", self.site, self._endpoint, why)
            except Exception as error:
                why = describe(error)
                log.exception("%s: %s; remedy: report this traceback", self.site, self._endpoint)
            self._absent = f"not connected to {self._endpoint}: {why}"
            self._event(partial(self._conversation.down, f"the connection was lost: {why}"))
            await asyncio.sleep(self._reconnect_s)
            self._reconnect_s = min(2 * self._reconnect_s, RECONNECT_MAX_S)

    def _begin(self) -> None:
        """The server is ready."""
        log.info("%s: %s is up", self.site, self._endpoint)
        self._conversation.up(time.perf_counter())
        self._absent = None
        self._plan()

    async def _converse(self, channel: Channel) -> None:
        """Send and receive until the connection ends, which raises its reason."""
        self._broken = self._loop.create_future()
        self._outbox: asyncio.Queue[Observation | int] = asyncio.Queue()  # observations and heartbeats
        parts = [
            self._loop.create_task(part) for part in (self._send_all(channel), self._receive_all(channel))
        ]
        try:
            ended, _ = await asyncio.wait([*parts, self._broken], return_when=asyncio.FIRST_COMPLETED)
            for part in ended:
                part.result()
        finally:
            for part in parts:
                part.cancel()
            await asyncio.gather(*parts, return_exceptions=True)

    async def _receive_all(self, channel: Channel) -> None:
        while True:
            message = await channel.receive()
            self._take(message, time.perf_counter())

    async def _send_all(self, channel: Channel) -> None:
        while True:
            one = await self._outbox.get()
            if isinstance(one, int):
                await channel.ping(partial(self._pong, one))
            else:
                await channel.send(one.data)

    def _event(self, event: Callable[[float], Instructions]) -> None:
        """Tell the conversation of an event, and do what it returns."""
        self._do(event(time.perf_counter()))

    def _do(self, instructions: Instructions) -> None:
        for one in instructions:
            match one:
                case Send(Observation() as observation):
                    observation.bytes_out = len(observation.data)
                    self._outbox.put_nowait(observation)
                case Ping(number):
                    self._outbox.put_nowait(number)
                case Finish(request, execution):
                    request.future.set_result(execution)
                case Reconnect(why) if not self._broken.done():
                    self._broken.set_exception(CloudBroken(why))
        self._plan()

    def _plan(self) -> None:
        """Wake up when something is due."""
        if self._timer is not None:
            self._timer.cancel()
        wakes_s = self._conversation.wakes_s
        if self._conversation.connected and wakes_s < math.inf:
            left_s = max(0.0, wakes_s - time.perf_counter())
            self._timer = self._loop.call_later(left_s, self._event, self._conversation.time)

    def _take(self, message: bytes | str, now_s: float) -> None:
        self._conversation.heard(now_s, ServerReport())
        observation = self._conversation.asked()
        if isinstance(observation, Observation):
            execution = observation.answered(message, now_s)
            bad = None
            if execution.failure is None:
                self._reconnect_s = RECONNECT_S
            else:  # a server whose answers are bad is left out for a while
                why = str(execution.failure)
                self._warn(why)
                bad = CannotCross(why)
            self._pauses.note(observation.task.kind.name, bad, now_s)
            self._do([self._conversation.answered(observation, execution, now_s)])
        self._plan()

    def _pong(self, number: int) -> None:
        self._conversation.pong(number, time.perf_counter(), ServerReport())
        self._plan()

    def _warn(self, why: str) -> None:
        text = f"{why}; remedy: see the log of that server"
        self._log(logging.WARNING, text, time.perf_counter())


def protocol_of(endpoint: str, token: str | None) -> PolicyProtocol:
    """The protocol of the server at this endpoint. MissingExtra if its library is not installed."""
    return (Groot if endpoint.startswith(GROOT) else OpenPi)(endpoint, token)
