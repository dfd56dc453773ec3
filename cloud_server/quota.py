"""How much each robot may send in a second, and how often it is told that this was too much."""

from collections import OrderedDict
from dataclasses import dataclass
from enum import Enum, auto

from common.bucket import Bucket

BURST_S = 1.0  # of what a robot may send that it may send at once
MESSAGE_BYTES = 64 * 1024  # what a message counts for at least: reading it takes time too
BUSY_A_S = 200.0  # refusals of one robot; what it sends beyond them is not read
ROBOTS_MAX = 4096  # of which this is known; beyond it those are forgotten that were silent for longest


class Verdict(Enum):
    TAKE = auto()
    REFUSE = auto()
    DROP = auto()


@dataclass(slots=True)
class _Robot:
    bytes_left: Bucket
    refusals_left: Bucket
    at_s: float


class Quota:
    """A token bucket for each robot: `bytes_a_s`, at once not less than a message of `message_bytes_max`."""

    def __init__(self, bytes_a_s: float, message_bytes_max: int) -> None:
        self._rate = bytes_a_s
        self._most = max(BURST_S * bytes_a_s, message_bytes_max)
        self._robots: OrderedDict[bytes, _Robot] = OrderedDict()

    def judge(self, name: bytes, size: int, now_s: float) -> Verdict:
        """What to do with a message of this size; only what is taken counts against the robot."""
        robot = self._robots.pop(name, None) or _Robot(
            Bucket(self._rate, self._most, self._most), Bucket(BUSY_A_S, BUSY_A_S, BUSY_A_S), now_s
        )
        self._robots[name] = robot
        if len(self._robots) > ROBOTS_MAX:
            self._robots.popitem(last=False)
        for bucket in (robot.bytes_left, robot.refusals_left):
            bucket.fill(now_s - robot.at_s)
        robot.at_s = now_s
        cost = max(size, MESSAGE_BYTES)
        if cost <= robot.bytes_left.level:
            robot.bytes_left.take(cost)
            return Verdict.TAKE
        if robot.refusals_left.level >= 1:
            robot.refusals_left.take(1)
            return Verdict.REFUSE
        return Verdict.DROP
