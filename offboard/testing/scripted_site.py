"""A server that does what a test says: it is slow, dead, lying, late, or back again.

Times are virtual, and the functions of the tasks really run. Where a task runs is left to the offloader.
"""

from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any

from offboard.common.errors import BadValue, CannotCross, describe
from offboard.common.tasks import Kind, Task
from offboard.common.wire.payload import payload_bytes
from offboard.common.wire.values import decode, encode
from offboard.robot_client.sites.absence import SiteView
from offboard.robot_client.sites.conversation import IN_FLIGHT_MAX, PendingRequest
from offboard.robot_client.sites.heartbeat import Heartbeat, ServerReport
from offboard.robot_client.sites.runner import Execution, Lasting, Sending
from offboard.testing.task_script import Seconds, TaskScript
from offboard.testing.virtual_clock import VirtualClock
from offboard.testing.virtual_driver import VirtualDriver

ROUND_TRIP_S = 0.01  # at most half of what a task takes, if that is known
LATE_S = 0.1  # after its budget comes an answer that is late


class ScriptedSite(TaskScript, VirtualDriver):
    """A server that a test makes slow, dead, lying or late, and brings back.

    The robot talks to it as to a real server: heartbeats and timeouts are those of the library.
    Each task takes `seconds`, with the way there and back, and any number of tasks run at a time.
    Arguments and results arrive as from a real server: tuples as lists, and arrays read-only.

    round_trip_s: how much of `seconds` is the way there and back; the answer to a heartbeat takes as long.
    """

    def __init__(self, clock: VirtualClock, seconds: Seconds, *, site: str, heartbeat: Heartbeat) -> None:
        TaskScript.__init__(self, seconds)
        self.round_trip_s = ROUND_TRIP_S if callable(seconds) else min(ROUND_TRIP_S, seconds / 2)
        self._dead = self._late = False
        self._tell: Callable[[Any], Any] = _truth
        self._held: deque[Callable[[], None]] = deque(maxlen=IN_FLIGHT_MAX)  # messages on a link that is dead
        VirtualDriver.__init__(self, clock, site=site, heartbeat=heartbeat)

    def dead(self) -> None:
        """From now on, neither answers nor heartbeats come: the link fails without a sign.

        What is sent meanwhile arrives after `back`.
        """
        self._dead = True

    def gone(self) -> None:
        """The connection is lost: runs under way fail, and no task is sent until `back`."""
        self._held.clear()
        self._down()

    def late(self) -> None:
        """From now on, each answer comes after the timeout of its task; heartbeats are answered."""
        self._late = True

    def lie(self, wrong: Any) -> None:
        """From now on, tasks return this wrong value, or what a function makes of the right one."""
        self._tell = wrong if callable(wrong) else lambda _: wrong

    def back(self) -> None:
        """From now on, the server is as it was at first. A lost connection is there again at once."""
        super().back()
        self._dead = self._late = False
        self._tell = _truth
        if not self.conversation.connected:
            self._up()
        while self._held:
            self._held.popleft()()

    def unavailable(self, kind: Kind) -> str | None:
        absent = super().unavailable(kind)
        return None if absent is None else Lasting(absent)  # only the test brings it back: nobody waits

    def to_send(self, task: Task) -> Sending:
        return Sending(payload_bytes(task.args))

    def look(self) -> SiteView:
        connected = self.conversation.connected
        why_absent = None if connected else "not connected"
        return SiteView(connected=connected, why_absent=why_absent, story=self.conversation.story)

    def _send(self, request: PendingRequest) -> None:
        self._clock.after(0.0, partial(self._pass, partial(self._serve, request)))

    def _cancel(self, task: Task) -> None:
        pass  # a run has no cost, and its answer finds nobody

    def _beat(self, number: int) -> None:
        pong = partial(self._pass, partial(self._pong, number, ServerReport()))
        self._pass(partial(self._clock.after, self.round_trip_s, pong))

    def _pass(self, message: Callable[[], None]) -> None:
        """Let a message through, or hold it while the link is dead."""
        if self._dead:
            self._held.append(message)
        else:
            message()

    def _serve(self, request: PendingRequest) -> None:
        """A request has arrived at the server."""
        if request.future.done():
            return
        seconds = self._takes_s(request.task)
        if self._late:
            seconds = max(seconds, request.deadline_s - self._clock.now_s() + LATE_S)
        answer = self._answer(request, run_s=max(0.0, seconds - self.round_trip_s))
        self._clock.after(seconds, partial(self._pass, partial(self._take, request, answer)))

    def _answer(self, request: PendingRequest, run_s: float) -> Execution:
        """The answer to a request; its value has crossed the link, as the arguments have."""
        kind = request.task.kind.at(self.site)
        answer = Execution(self.site, 0.0, queue_s=0.0, run_s=run_s, cpu_s=run_s, started=False)
        try:
            args, answer.bytes_out = _arrived(request.task)
            request.bytes_out, answer.started = answer.bytes_out, True
            value, answer.failure = self._call(request.task, kind, args, request.future)
            if answer.failure is None:
                answer.value, answer.bytes_in = _carried(self._tell(value), kind, "result")
        except CannotCross as failure:
            answer.failure = failure
        return answer

    def _take(self, request: PendingRequest, answer: Execution) -> None:
        """An answer has arrived at the robot."""
        with self._lock:
            now_s = self._clock.now_s()
            self.conversation.heard(now_s, ServerReport())
            if self.conversation.asked(request.task.id) is request:
                answer.seconds = now_s - request.published_s
                answer.network_s = max(0.0, answer.seconds - (answer.run_s or 0.0))
                self._answered(request, answer)


def _truth(value: Any) -> Any:
    return value


def _arrived(task: Task) -> tuple[tuple[Any, ...], int]:
    """The arguments as they arrive at a server, and the bytes sent; CannotCross if they do not arrive."""
    kind, values = task.kind, list(task.args)
    if kind.pack is None or kind.unpack is None:
        arrived, count = _carried(values, kind, "arguments")
        return tuple(arrived), count
    try:
        packed, count = _carried(kind.pack(*values), kind, "arguments")
        return kind.arguments_in(kind.unpack(packed)), count
    except Exception as error:  # the functions are the user's own
        raise CannotCross(f"arguments: {describe(error)}") from error


def _carried(value: Any, kind: Kind, name: str) -> tuple[Any, int]:
    """A value as it arrives at the other side, and its bytes; CannotCross if it cannot be sent."""
    try:
        frames = [bytes(frame) for frame in encode(value, kind.types, name=name).frames]
        return decode(frames, kind.types, {}), sum(map(len, frames))
    except Exception as error:  # such as a class of the user that raises when it is looked at
        raise CannotCross(
            str(error) if isinstance(error, BadValue) else f"{name}: {describe(error)}"
        ) from error
