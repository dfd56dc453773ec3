"""How much each robot may send in a second, and what comes of sending more."""

import math
from collections import OrderedDict
from dataclasses import dataclass
from enum import Enum, auto

from offboard.common.token_bucket import Bucket

BURST_S = 1.0  # of what a robot may send that it may send at once
MESSAGE_BYTES = 64 * 1024  # what a message counts for at least: reading it takes time too
BUSY_A_S = 200.0  # refusals of one robot; what it sends beyond them is not read
EXCESS_S = 2.0  # of what a robot may send, that it may send beyond it: who floods on and on is cut off
CUT_OFF_S = 10.0  # for which that robot is not let in again
ROBOTS_MAX = 4096  # of which this is known; beyond it those are forgotten that were silent for longest


class Verdict(Enum):
    TAKE = auto()
    REFUSE = auto()
    DROP = auto()
    CUT_OFF = auto()


@dataclass(slots=True)
class _Robot:
    bytes_left: Bucket
    refusals_left: Bucket
    excess_left: Bucket
    at_s: float
    cut_until_s: float = -math.inf


class Quota:
    """A token bucket for each robot: `bytes_a_s`, at once not less than a message of `message_bytes_max`."""

    def __init__(self, bytes_a_s: float, message_bytes_max: int) -> None:
        self._rate = bytes_a_s
        self._most = max(BURST_S * bytes_a_s, message_bytes_max)
        self._robots: OrderedDict[bytes, _Robot] = OrderedDict()

    def judge(self, name: bytes, size: int, now_s: float) -> Verdict:
        """What to do with a message of this size; only what is taken counts against the robot."""
        robot = self._robots.pop(name, None) or self._new(now_s)
        self._robots[name] = robot
        if len(self._robots) > ROBOTS_MAX:
            self._robots.popitem(last=False)
        for bucket in (robot.bytes_left, robot.refusals_left, robot.excess_left):
            bucket.fill(now_s - robot.at_s)
        robot.at_s = now_s
        if now_s < robot.cut_until_s:
            return Verdict.DROP
        cost = max(size, MESSAGE_BYTES)
        if cost <= robot.bytes_left.level:
            robot.bytes_left.take(cost)
            return Verdict.TAKE
        robot.excess_left.take(cost)
        if robot.excess_left.level < 0:
            robot.excess_left.level = robot.excess_left.most
            robot.cut_until_s = now_s + CUT_OFF_S
            return Verdict.CUT_OFF
        if robot.refusals_left.level >= 1:
            robot.refusals_left.take(1)
            return Verdict.REFUSE
        return Verdict.DROP

    def _new(self, now_s: float) -> _Robot:
        left = Bucket(self._rate, self._most, self._most)
        excess = EXCESS_S * self._most
        return _Robot(left, Bucket(BUSY_A_S, BUSY_A_S, BUSY_A_S), Bucket(self._rate, excess, excess), now_s)
