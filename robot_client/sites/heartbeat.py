"""Heartbeats: small messages that a server answers at once.

An answer shows that the server is there, how long a round trip takes, how many tasks wait in its queue, and
how busy its CPU is. `Heartbeat` is pure: times come in as arguments. Sending is left to `cloud`.
"""

import time
from collections import deque
from random import Random
from typing import NamedTuple

from offboard.robot_client.sites.runner import Condition

EVERY_S = 0.5  # between two heartbeats: an outage is noticed at most this much later
IDLE_S = 2.0  # between two heartbeats once there was no task for as long: a fleet has many idle robots
JITTER = 0.2  # each pause is up to this share shorter or longer, so that the robots of a fleet spread out
EARLY_S = 0.1  # a heartbeat that is due within this time is sent just before a task: no thread must wake up
SILENT_S = 0.25  # a site is silent if nothing came for longer than this, and longer than round trips vary
SLACK_S = 0.02  # an answer is late if it takes this much longer than usual, and longer than round trips vary
UNANSWERED_MAX = 16  # heartbeats that are remembered
LEAST_OF = 2  # the shortest of that many round trips counts: one stalled segment does not make a slow link
LOADED_SLOWER = 3  # times as long are the pauses of background work on a loaded robot


class ServerReport(NamedTuple):
    """What a server says about itself; `wire.messages.Pong` explains the fields."""

    queue: int = 0
    load: float = 0.0
    capacity: float = 1.0
    waits_s: float = 0.0


class Heartbeat:
    """Times the heartbeats of one connection, and measures it.

    every_s: usual pause; 0: no heartbeat is sent, and nothing is measured. Pauses are longer while
        nobody asks for the condition of the site.
    background: makes pauses longer on a loaded robot, and knows when the robot hears late.
    """

    def __init__(self, every_s: float, seed: int = 0, background: "Background | None" = None) -> None:
        self._every_s = every_s
        self._background = background or Background()
        self._random = Random(seed)
        self._next_id = 0
        self._round_trip_s: float | None = None
        self._asked_s = self._beat_s = -float("inf")  # the condition was asked for; a heartbeat was sent
        self.stop()

    def start(self, now_s: float) -> None:
        """The connection is up."""
        self.stop()
        self._asked_s = now_s
        if self._every_s:
            self._due_s = self._idle_due_s = now_s

    def stop(self) -> None:
        """The connection has ended. Only the last round trip is kept: the next connection starts from it."""
        self._due_s = self._idle_due_s = float("inf")
        self._sent: dict[int, float] = {}
        self._oldest_s = float("inf")  # when the oldest unanswered heartbeat was sent
        self._heard_s = -float("inf")
        self._recent: deque[float] = deque(maxlen=LEAST_OF)
        self._smooth_s = self._varies_s = 0.0
        self._back_s = -float("inf")  # when a silence ended
        self._measured = False  # whether a heartbeat that was sent after that has been answered
        self._report = ServerReport()
        self._usual = self._condition()  # the condition while no heartbeat is unanswered

    @property
    def due_s(self) -> float:
        """When the next heartbeat is due. Whoever asks for the condition of an idle site makes it sooner."""
        return self._idle_due_s if self._beat_s - self._asked_s > IDLE_S else self._due_s

    @property
    def unanswered(self) -> int:
        """How many heartbeats have no answer yet; at most UNANSWERED_MAX are remembered."""
        return len(self._sent)

    def hurry(self, now_s: float) -> None:
        """A task is late: the next heartbeat is due now, unless one is unanswered already."""
        if self._oldest_s > now_s and self._due_s < float("inf"):
            self._due_s = self._idle_due_s = now_s

    def beat(self, now_s: float) -> int:
        """A heartbeat is sent now; returns its number."""
        self._next_id += 1
        self._sent[self._next_id] = now_s
        self._oldest_s = min(self._oldest_s, now_s)
        factor = 1 + JITTER * self._random.uniform(-1, 1)
        if len(self._sent) > UNANSWERED_MAX:
            del self._sent[next(iter(self._sent))]
        self._beat_s = now_s
        self._due_s = now_s + factor * self._background.pause_s(self._every_s)
        self._idle_due_s = max(self._due_s, now_s + factor * IDLE_S)
        return self._next_id

    def answer(self, id: int, now_s: float, report: ServerReport) -> None:
        """The server has answered the heartbeat of this number."""
        sent_s = self._sent.pop(id, None)
        if sent_s is None:
            return
        # Answers keep their order: earlier heartbeats were lost with the connection that carried them.
        for older in [number for number in self._sent if number < id]:
            del self._sent[older]
        self._come_back(now_s)
        self._oldest_s = next(iter(self._sent.values()), float("inf"))
        if sent_s < self._back_s:
            self.hurry(now_s)  # the silence delayed this answer, so it does not measure the link as it is now
        else:
            self._measure(now_s - sent_s, at_most=self._background.computed_since(sent_s))
        self.hear(now_s, report)

    def _measure(self, round_trip_s: float, *, at_most: bool) -> None:
        """With `at_most`, the robot computed at that time and may have read the answer late."""
        self._vary(round_trip_s)
        self._measured = True
        if at_most and self._round_trip_s is not None:
            self._round_trip_s = min(round_trip_s, self._round_trip_s)
        else:
            self._recent.append(round_trip_s)
            self._round_trip_s = min(self._recent)

    def hear(self, now_s: float, report: ServerReport) -> None:
        """Any message from the server shows that it is there."""
        self._come_back(now_s)
        self._heard_s = now_s
        if self._report != report or self._usual.round_trip_s != self._round_trip_s:
            self._report = report
            self._usual = self._condition()

    def condition(self, now_s: float) -> Condition:
        """A late answer is expected to take as long again as it has taken so far."""
        self._asked_s = now_s
        if self._oldest_s > now_s:
            return self._usual
        unheard_s = self._unheard_s(now_s)
        silent = self._silent(now_s)
        late = silent or (self._smooth_s > 0 and unheard_s > max(self._smooth_s + SLACK_S, self._limit_s))
        return self._condition(silent=silent, wait_s=unheard_s if late else 0.0)

    def _condition(self, *, silent: bool = False, wait_s: float = 0.0) -> Condition:
        queue, load, capacity, queue_s = self._report
        return Condition(
            self._round_trip_s, silent, queue,
            wait_s=wait_s, capacity=capacity, server_load=load, queue_s=queue_s,
        )  # fmt: skip

    def _unheard_s(self, now_s: float) -> float:
        """Seconds since a heartbeat went unanswered and nothing else came; negative if all are answered."""
        return now_s - max(self._oldest_s, self._heard_s)

    @property
    def _limit_s(self) -> float:
        return self._smooth_s + 4 * self._varies_s

    def _silent(self, now_s: float) -> bool:
        return self._unheard_s(now_s) > max(SILENT_S, self._limit_s)

    def _come_back(self, now_s: float) -> None:
        """A link that is silent again before anything was measured is slow, and is measured as it is."""
        if self._measured and self._silent(now_s):
            self._back_s, self._measured = now_s, False

    def _vary(self, round_trip_s: float) -> None:
        """Learn how much round trips vary (RFC 6298): a link that is always slow is not silent."""
        if not self._smooth_s:
            self._smooth_s, self._varies_s = round_trip_s, round_trip_s / 2
            return
        self._varies_s += 1 / 4 * (abs(round_trip_s - self._smooth_s) - self._varies_s)
        self._smooth_s += 1 / 8 * (round_trip_s - self._smooth_s)


class Background:
    """What background work must know of the tasks of the robot: both need the same CPU.

    On a tenth of a CPU, or next to a library that holds the interpreter's lock, a robot that computes hears
    late from other sites. Shared by all runners of one offloader.

    loaded: other programs take so much of the CPU that measured times show it.
    """

    def __init__(self) -> None:
        self.loaded = False
        self._computing = 0
        self._computed_s = float("-inf")  # when a run onboard last ended

    def pause_s(self, usual_s: float) -> float:
        """The seconds to wait before the next step of work that is usually done this often."""
        return LOADED_SLOWER * usual_s if self.loaded else usual_s

    def begin(self) -> None:
        """A run onboard begins. Called under the lock of the onboard runner, like `end`."""
        self._computing += 1

    def end(self) -> None:
        self._computing -= 1
        self._computed_s = time.perf_counter()

    def computed_since(self, at_s: float) -> bool:
        """Whether a task ran onboard at this time of `time.perf_counter`, or later."""
        return self._computing > 0 or self._computed_s >= at_s
