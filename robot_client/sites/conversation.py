"""The conversation with one remote site: which request is sent when, how each ends, and the heartbeats.

A state machine without sockets, threads and clocks. Its driver tells it of each event, with the time, and
does what it returns; what a message looks like is up to the driver.
"""

import math
from collections import deque
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import NamedTuple

from offboard.common.errors import (
    CloudBroken,
    CloudBusy,
    CloudTimeout,
    OffloadError,
    Overtaken,
    ProtocolError,
    SiteClosed,
)
from offboard.common.tasks import Task
from offboard.robot_client.sites.heartbeat import EARLY_S, Heartbeat, ServerReport
from offboard.robot_client.sites.runner import Condition, Execution, Packed

IN_FLIGHT_MAX = 1024  # requests without an answer; more are refused
IN_TURN_MAX = 16  # the same, for a server that takes one at a time
OWED_MAX_S = 60.0  # for which the answer to a request that was given up keeps the connection
STORY_MAX = 64  # events and instructions that are remembered
NOT_SENT = "nothing can be sent"


@dataclass(eq=False, slots=True, kw_only=True)
class PendingRequest:
    """One run of a task at a remote site, without an answer so far. Times are readings of one clock, in s.

    bytes_out: what was sent of it. sent_s: when it had its turn; None: it has not.
    """

    site: str
    task: Task
    published_s: float
    deadline_s: float
    future: "Future[Execution]" = field(default_factory=Future)
    bytes_out: int = 0
    sent_s: float | None = None

    @property
    def packed(self) -> tuple[Packed, ...]:
        """What was packed for it."""
        return ()

    def given_up(
        self, failure: OffloadError, now_s: float, *, censored: bool = False, started: bool = True
    ) -> Execution:
        """The execution without an answer. `started`: false if the site says that it did not begin."""
        return Execution(
            self.site,
            now_s - self.published_s,
            failure=failure,
            censored=censored,
            bytes_out=self.bytes_out,
            started=started and self.sent_s is not None,
            packed=self.packed,
        )


class Send(NamedTuple):
    """Send this request."""

    request: PendingRequest


class Cancel(NamedTuple):
    """Tell the server that nobody wants the answer to this request."""

    request: PendingRequest


class Ping(NamedTuple):
    """Send the heartbeat of this number."""

    number: int


class Finish(NamedTuple):
    """Give the future of this request its execution."""

    request: PendingRequest
    execution: Execution


class Reconnect(NamedTuple):
    """End the connection, and connect again."""

    why: str


Instructions = list[Send | Cancel | Ping | Finish | Reconnect]


class Happened(NamedTuple):
    """An event or an instruction: when, what, and the task or the heartbeat that it is about."""

    at_s: float
    what: str
    id: int | None


class Conversation:
    """Follows the requests to one site. Not for several threads at once: its driver holds a lock.

    Each event comes with its time, and returns what is to be done, in order. `time` must be called at
    `wakes_s`, which every event may change.

    in_turn: the server numbers neither requests nor answers, so one request is under way at a time. If it is
        given up, its answer is still due, and the next request waits for that. Such a server often computes
        in the thread that would answer a heartbeat, so none is sent meanwhile.
    """

    def __init__(self, heartbeat: Heartbeat, *, in_turn: bool = False) -> None:
        self.connected = False
        self.closed = False
        self._heartbeat = heartbeat
        self._in_turn = in_turn
        self._unanswered: dict[int, PendingRequest] = {}
        self._waiting: deque[PendingRequest] = deque()  # those that were not sent yet
        self._under_way: PendingRequest | None = None  # with `in_turn`
        self._owed_since_s: float | None = None  # its answer is due, and nobody waits for it
        self._story: deque[tuple[float, str, int | None]] = deque(maxlen=STORY_MAX)

    @property
    def in_flight(self) -> int:
        """How many requests have no answer yet."""
        return len(self._unanswered)

    @property
    def owes(self) -> bool:
        """Whether the server still computes an answer that nobody waits for."""
        return self._owed_since_s is not None

    def expects_message(self) -> bool:
        """Whether any message is due."""
        return bool(self._unanswered or self._heartbeat.unanswered or self._under_way)

    @property
    def story(self) -> tuple[Happened, ...]:
        """The last events and instructions, the oldest first."""
        return tuple(Happened(*one) for one in self._story.copy())  # an event may come meanwhile

    @property
    def wakes_s(self) -> float:
        """When `time` must be called, if nothing happens before."""
        due_s = math.inf
        if self._under_way is None:
            due_s = -math.inf if self._waiting else self._heartbeat.due_s
        elif self._owed_since_s is not None:
            due_s = self._owed_since_s + OWED_MAX_S
        for request in self._unanswered.values():
            if request.deadline_s < due_s:
                due_s = request.deadline_s
        return due_s

    def condition(self, now_s: float) -> Condition:
        return self._heartbeat.condition(now_s)

    def up(self, now_s: float) -> None:
        """The server can take requests."""
        self.connected = True
        self._story.append((now_s, "up", None))
        self._heartbeat.start(now_s)

    def down(self, why: str, now_s: float) -> Instructions:
        """The connection has ended."""
        self._end("down", now_s)
        return [self.fail(one, CloudBroken(why), now_s) for one in list(self._unanswered.values())]

    def close(self, now_s: float) -> Instructions:
        """The site is not used any more. The last request goes first: no place is free before that."""
        self.closed = True
        self._end("close", now_s)
        left = list(reversed(self._unanswered.values()))
        cancels: Instructions = [] if self._in_turn else [Cancel(one) for one in left]
        return cancels + [
            self.fail(one, SiteClosed("closed while the task was in flight"), now_s) for one in left
        ]

    def submit(self, request: PendingRequest, now_s: float) -> Instructions:
        """A task is to run on the site. It is refused without a connection, and if too many are in flight."""
        self._story.append((now_s, "submit", request.task.id))
        most = IN_TURN_MAX if self._in_turn else IN_FLIGHT_MAX
        self._unanswered[request.task.id] = request
        if not self.connected:
            return [self.fail(request, CloudBroken(NOT_SENT), now_s)]
        if len(self._unanswered) > most:
            return [self.fail(request, CloudBusy(f"{most} tasks are in flight"), now_s)]
        if request.deadline_s > now_s:
            self._waiting.append(request)
        return self._go_on(now_s)

    def time(self, now_s: float) -> Instructions:
        """Do what is due: give up what takes too long, and send heartbeats and what may be sent."""
        due: Instructions = []
        for request in [one for one in self._unanswered.values() if one.deadline_s <= now_s]:
            due += self._give_up(request, CloudTimeout("no answer within the budget"), now_s)
        if self._owed_since_s is not None and now_s >= self._owed_since_s + OWED_MAX_S:
            self._owed_since_s = now_s
            due.append(Reconnect(f"it has not answered for {OWED_MAX_S:g} s"))
        return due + self._go_on(now_s)

    def cancel(self, id: int, now_s: float) -> Instructions:
        """Nobody wants the answer to the request of this task any more."""
        request = self._unanswered.get(id)
        if request is None:
            return []
        self._story.append((now_s, "cancel", id))
        return self._give_up(request, Overtaken("its answer is no longer needed"), now_s)

    def hurry(self, now_s: float) -> Instructions:
        """An answer is late: the next heartbeat is due now."""
        self._heartbeat.hurry(now_s)
        return []

    def pong(self, number: int, now_s: float, report: ServerReport) -> None:
        """The server has answered the heartbeat of this number."""
        self._story.append((now_s, "pong", number))
        self._heartbeat.answer(number, now_s, report)

    def heard(self, now_s: float, report: ServerReport) -> None:
        """Any other message of the server has come."""
        self._heartbeat.hear(now_s, report)

    def asked(self, id: int | None = None) -> PendingRequest | None:
        """The request that a message answers, by its number; None: it was given up.

        With `in_turn` messages have no number; ProtocolError if no request is under way.
        """
        if self._in_turn:
            if self._under_way is None:
                raise ProtocolError("the server sent a message that no request asked for")
            id = self._under_way.task.id
            self._under_way = self._owed_since_s = None
        return None if id is None else self._unanswered.get(id)

    def answered(self, request: PendingRequest, execution: Execution, now_s: float) -> Finish:
        """The answer to a request has been read."""
        del self._unanswered[request.task.id]
        self._story.append((now_s, "fail" if execution.failure else "answer", request.task.id))
        return Finish(request, execution)

    def fail(
        self, request: PendingRequest, failure: OffloadError, now_s: float, *, started: bool = True
    ) -> Finish:
        """A request can have no answer. `started`: false if its task certainly did not begin."""
        return self.answered(request, request.given_up(failure, now_s, started=started), now_s)

    def _go_on(self, now_s: float) -> Instructions:
        """Send what may be sent now. A heartbeat that is due soon goes just before a request."""
        due: Instructions = []
        if self._under_way is not None:
            return due
        if self._heartbeat.due_s <= now_s + (EARLY_S if self._waiting else 0.0):
            number = self._heartbeat.beat(now_s)
            self._story.append((now_s, "ping", number))
            due.append(Ping(number))
        while self._waiting and self._under_way is None:
            request = self._waiting.popleft()
            request.sent_s = now_s
            if self._in_turn:
                self._under_way = request
            self._story.append((now_s, "send", request.task.id))
            due.append(Send(request))
        return due

    def _give_up(self, request: PendingRequest, failure: OffloadError, now_s: float) -> Instructions:
        """End a request whose answer may still come."""
        if request is self._under_way:
            self._owed_since_s = now_s
        elif request.sent_s is None and request in self._waiting:
            self._waiting.remove(request)
        self._heartbeat.hurry(now_s)
        finish = self.answered(request, request.given_up(failure, now_s, censored=True), now_s)
        return [finish] if self._in_turn else [Cancel(request), finish]

    def _end(self, how: str, now_s: float) -> None:
        self.connected, self._under_way, self._owed_since_s = False, None, None
        self._story.append((now_s, how, None))
        self._heartbeat.stop()
        self._waiting.clear()
