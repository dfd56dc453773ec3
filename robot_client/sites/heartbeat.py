"""Heartbeats: small questions to a server; answers tell the round trip, queue and CPU, and that it is there.

Pure: time comes in as an argument; who sends them is `cloud`.
"""

from collections import deque
from random import Random
from typing import NamedTuple

from offboard.robot_client.sites.own_cpu import OwnCpu, may_be_late
from offboard.robot_client.sites.runner import Condition

EVERY_S = 0.5
JITTER = 0.2  # each comes up to this share earlier or later: robots of a fleet do not beat together
ALONG_S = 0.1  # so much earlier one goes ahead of a task, whose answer is waited for anyway
SILENT_S = 0.25  # unanswered for longer than this, and longer than round trips vary: the site is silent
SLACK_S = 0.02  # beyond the usual round trip, if they vary no more: so much later an answer is late
UNANSWERED_MAX = 16  # remembered; while so many are out they come SLOWER times as rarely
SLOWER = 5
LEAST_OF = 2  # round trips: one stalled segment is no slow link, and one that is quick again is believed
BESIDE_LEAST_OF = 4  # where the robot computed meanwhile, and that may be why they are longer
_SMOOTHING, _VARIATION = 1 / 8, 1 / 4  # of RFC 6298


class Told(NamedTuple):
    """What a server says of itself, as in `wire.messages`."""

    queue: int = 0
    load: float = 0.0
    capacity: float = 1.0


class Heartbeat:
    """Of one connection. `every_s` 0: none are sent, and nothing is known. `own_cpu`: of the robot."""

    def __init__(self, every_s: float, seed: int = 0, own_cpu: OwnCpu | None = None) -> None:
        self._every_s = every_s
        self._own_cpu = own_cpu or OwnCpu()
        self._random = Random(seed)
        self._next_id = 0
        self._round_trip_s: float | None = None
        self.stop()

    def start(self, now_s: float) -> None:
        """The connection is up."""
        self.stop()
        if self._every_s:
            self.due_s = now_s

    def stop(self) -> None:
        """The connection is gone: nothing is known of the next one until it tells but the last round trip."""
        self.due_s = float("inf")
        self._sent: dict[int, float] = {}
        self._oldest_s = float("inf")  # when the first that is unanswered was sent
        self._heard_s = -float("inf")
        self._recent: deque[float] = deque(maxlen=BESIDE_LEAST_OF)
        self._smooth_s = self._varies_s = 0.0
        self._back_s = -float("inf")  # when the site was last heard again
        self._told = Told()
        self._usual = self._condition()  # while no answer is waited for

    @property
    def unanswered(self) -> int:
        """How many are, of those remembered."""
        return len(self._sent)

    def hurry(self, now_s: float) -> None:
        """A task is late: ask now whether the server is there, unless it was asked already."""
        if self._oldest_s > now_s and self.due_s < float("inf"):
            self.due_s = now_s

    def beat(self, now_s: float) -> int:
        """The number of the heartbeat to send now."""
        self._next_id += 1
        self._sent[self._next_id] = now_s
        self._oldest_s = min(self._oldest_s, now_s)
        pause_s = self._own_cpu.pause_s(self._every_s) * (1 + JITTER * self._random.uniform(-1, 1))
        if len(self._sent) > UNANSWERED_MAX:
            del self._sent[next(iter(self._sent))]
            pause_s *= SLOWER
        self.due_s = now_s + pause_s
        return self._next_id

    def answer(self, id: int, now_s: float, told: Told) -> None:
        """The answer to one of them."""
        sent_s = self._sent.pop(id, None)
        if sent_s is None:
            return
        # They come back in order: those before it were lost with the connection that carried them.
        for older in [number for number in self._sent if number < id]:
            del self._sent[older]
        self._come_back(now_s)
        self._oldest_s = next(iter(self._sent.values()), float("inf"))
        self._vary(now_s - sent_s)
        if sent_s < self._back_s:
            self.hurry(now_s)  # it was held up by what made the site silent, and says nothing of the link now
        else:
            self._measure(now_s - sent_s, beside=self._own_cpu.since(sent_s))
        self.hear(now_s, told)

    def _measure(self, round_trip_s: float, *, beside: bool) -> None:
        self._recent.append(round_trip_s)
        if not (beside and may_be_late(round_trip_s, self._round_trip_s)):
            while len(self._recent) > LEAST_OF:
                self._recent.popleft()
        self._round_trip_s = min(self._recent)

    def hear(self, now_s: float, told: Told) -> None:
        """Anything that the server said shows that it is there."""
        self._come_back(now_s)
        self._heard_s = now_s
        if self._told != told or self._usual.round_trip_s != self._round_trip_s:
            self._told = told
            self._usual = self._condition()

    def condition(self, now_s: float) -> Condition:
        """A site whose answer is late is expected to be held up for as long again."""
        if self._oldest_s > now_s:
            return self._usual
        out_s = self._out_s(now_s)
        late = self._smooth_s > 0 and out_s > max(self._smooth_s + SLACK_S, self._limit_s)
        return self._condition(silent=self._silent(now_s), wait_s=out_s if late else 0.0)

    def _condition(self, *, silent: bool = False, wait_s: float = 0.0) -> Condition:
        queue, load, capacity = self._told
        return Condition(
            self._round_trip_s, silent, queue, wait_s=wait_s, capacity=capacity, server_load=load
        )

    def _out_s(self, now_s: float) -> float:
        """For how long an answer has been waited for and nothing was heard; negative: none is."""
        return now_s - max(self._oldest_s, self._heard_s)

    @property
    def _limit_s(self) -> float:
        return self._smooth_s + 4 * self._varies_s

    def _silent(self, now_s: float) -> bool:
        return self._out_s(now_s) > max(SILENT_S, self._limit_s)

    def _come_back(self, now_s: float) -> None:
        if self._silent(now_s):
            self._back_s = now_s

    def _vary(self, round_trip_s: float) -> None:
        """What is usual, whatever held it up: a link that is always slow is not silent."""
        if not self._smooth_s:
            self._smooth_s, self._varies_s = round_trip_s, round_trip_s / 2
            return
        self._varies_s += _VARIATION * (abs(round_trip_s - self._smooth_s) - self._varies_s)
        self._smooth_s += _SMOOTHING * (round_trip_s - self._smooth_s)
