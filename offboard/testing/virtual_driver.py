"""Drives the conversation with one remote site in virtual time, as the runner of a real server does.

What its messages are, and how they travel, is up to the subclasses.
"""

import math
import threading
from collections.abc import Callable
from concurrent.futures import Future

from offboard.common.tasks import Kind, Task
from offboard.robot_client.sites.conversation import (
    Cancel,
    Conversation,
    Finish,
    Instructions,
    PendingRequest,
    Ping,
    Send,
)
from offboard.robot_client.sites.heartbeat import Heartbeat, ServerReport
from offboard.robot_client.sites.runner import Condition, Execution
from offboard.testing.virtual_clock import VirtualClock


class VirtualAnswer(Future[Execution]):
    """The future of a run: an event of the clock ends it, and no thread."""


class VirtualDriver:
    """A server, as one robot uses it; `to_send` is missing to be a runner. Connected from the start."""

    def __init__(self, clock: VirtualClock, *, site: str, heartbeat: Heartbeat) -> None:
        self.site = site
        self.conversation = Conversation(heartbeat)
        self._clock = clock
        self._lock = threading.RLock()
        self._planned_s = math.inf  # when the clock calls `_wake`
        self._up()

    def unavailable(self, kind: Kind) -> str | None:  # noqa: ARG002 - the server knows every kind
        return None if self.conversation.connected else "not connected"

    def submit(self, task: Task, budget_s: float) -> "Future[Execution]":
        now_s, future = self._clock.now_s(), VirtualAnswer()
        request = PendingRequest(
            site=self.site, task=task, published_s=now_s, deadline_s=now_s + budget_s, future=future
        )
        self._event(lambda now_s: self.conversation.submit(request, now_s))
        return future

    def cancel(self, task: Task) -> None:
        self._event(lambda now_s: self.conversation.cancel(task.id, now_s))

    def hurry(self) -> None:
        self._event(self.conversation.hurry)

    def condition(self) -> Condition:
        return self.conversation.condition(self._clock.now_s())

    def close(self) -> None:
        self._event(self.conversation.close)

    def _send(self, request: PendingRequest) -> None:
        """Send a request. When its answer has come, `_answered` is called."""
        raise NotImplementedError

    def _cancel(self, task: Task) -> None:
        """Tell the server that nobody wants the answer to this task."""
        raise NotImplementedError

    def _beat(self, number: int) -> None:
        """Send a heartbeat. When its answer has come, `_pong` is called."""
        raise NotImplementedError

    def _up(self) -> None:
        self.conversation.up(self._clock.now_s())
        self._plan()

    def _down(self) -> None:
        self._event(lambda now_s: self.conversation.down("the connection was lost", now_s))

    def _pong(self, number: int, report: ServerReport) -> None:
        with self._lock:
            self.conversation.pong(number, self._clock.now_s(), report)
            self._plan()

    def _answered(self, request: PendingRequest, execution: Execution) -> None:
        self._event(lambda now_s: [self.conversation.answered(request, execution, now_s)])

    def _event(self, event: Callable[[float], Instructions]) -> None:
        """Tell the conversation of an event, and do what it returns."""
        with self._lock:
            for one in event(self._clock.now_s()):
                match one:
                    case Send(request):
                        self._send(request)
                    case Ping(number):
                        self._beat(number)
                    case Cancel(request):
                        self._cancel(request.task)
                    case Finish(request, execution):
                        request.future.set_result(execution)
            self._plan()

    def _plan(self) -> None:
        """Let the clock call when something is due."""
        wakes_s = self.conversation.wakes_s
        if wakes_s < self._planned_s:
            self._planned_s = wakes_s
            self._clock.at(wakes_s, self._wake)

    def _wake(self) -> None:
        with self._lock:
            self._planned_s = math.inf
            self._event(self.conversation.time)
