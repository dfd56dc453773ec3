"""Limits how much each robot may send per second, without clocks; `server` does what it decides."""

import math
from collections import OrderedDict
from dataclasses import dataclass
from enum import Enum, auto

from offboard.common.token_bucket import Bucket

BURST_S = 1.0  # a robot may send the amount of this many seconds at once
MESSAGE_BYTES = 64 * 1024  # a message counts as at least this many bytes: reading it takes time too
BUSY_A_S = 200.0  # answers `busy` to one robot per second; messages beyond them are not read
EXCESS_S = 2.0  # a robot that sends more than this many seconds' worth too much is cut off
CUT_OFF_S = 10.0  # until a robot that was cut off may connect again
ROBOTS_MAX = 4096  # robots remembered; the one that was silent for longest is forgotten first


class Verdict(Enum):
    """What to do with a message: read it, answer `busy`, ignore it, or cut off its robot."""

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


class RateLimit:
    """Token buckets for each robot. Even at a low rate, one message of `message_bytes_max` may be sent."""

    def __init__(self, bytes_per_s: float, message_bytes_max: int) -> None:
        self._rate = bytes_per_s
        self._most = max(BURST_S * bytes_per_s, message_bytes_max)
        self._robots: OrderedDict[bytes, _Robot] = OrderedDict()

    def judge(self, name: bytes, size: int, now_s: float) -> Verdict:
        """What to do with a message of this size. Only a message that is taken uses up the robot's bytes."""
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
