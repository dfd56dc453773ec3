"""The parts model: the time of a task is network, queue and run, and each part is learned by itself.

A reply says how long the task waited and ran at the server, so the rest of its time is the network's. This
file owns how parts are learned and added up; when a run says anything, is up to `learning/site.py`.
"""

import math
from dataclasses import dataclass, field

from offboard.common.host.load import LOADED
from offboard.robot_client.predictors.base import Prediction
from offboard.robot_client.predictors.line import RATE, Line
from offboard.robot_client.sites.runner import Condition

FIRST_RATE = 12.5e6
SLOW_RATE = 0.3  # loads are rare and short, so the factor under load is learned from few tasks
SLOW_AFTER = 6  # runs: only then a slow run under load says something about the load


@dataclass(frozen=True, slots=True)
class Times:
    """What one execution took, in seconds.

    `run_s` and `queue_s` as the site measured them; None: the site did not say, and the run counts as all
    that is beyond the round trip. `bound`: the robot may have read the answer late, so that what is beyond
    queue and run is an upper bound.
    """

    seconds: float
    run_s: float | None = None
    queue_s: float | None = None
    bound: bool = False


@dataclass(slots=True)
class _Usual:
    """A running mean that begins with the plain mean."""

    value: float = 0.0
    count: int = 0

    def add(self, one: float) -> None:
        self.count += 1
        self.value += max(RATE, 1.0 / self.count) * (one - self.value)


@dataclass(slots=True)
class Parts:
    """The model of one kind of task on one site. `remote`: there is a network between robot and site.

    Amounts and bytes are learned in units of the first ones, so that the numbers of all kinds are near 1.
    """

    remote: bool
    run: Line = field(default_factory=lambda: Line(together=True))
    network: Line = field(default_factory=lambda: Line(together=False))
    slow: float = 0.0  # how much longer a run takes under load; 0: unknown
    _usual_run: _Usual = field(default_factory=_Usual)
    _usual_delay: _Usual = field(default_factory=_Usual)
    _amount: float = 0.0
    _bytes: float = 0.0
    _round_trip_s: float | None = None

    def __len__(self) -> int:
        return self.run.count

    def predict(self, amount: float, moved: float, condition: Condition) -> Prediction | None:
        """The time of a task of this amount that moves this many bytes; None before the first run."""
        if not self.run.count:
            return None
        run_s = self._run_s(amount, condition)
        seconds, spread_s = run_s * (1.0 + self.run.tail), self.run.deviation * run_s
        if not self.remote:
            return Prediction(seconds, spread_s)
        self._heed(condition.round_trip_s)
        network_s = self._network_s(moved, condition)
        seconds += network_s * (1.0 + self.network.tail) + self._queue_s(condition)
        return Prediction(seconds, math.hypot(spread_s, self.network.deviation * network_s))

    def learn(self, amount: float, moved: float, times: Times, condition: Condition, ahead: int = 1) -> None:
        """An execution has ended, or was given up after a time that is longer than predicted."""
        rtt_s = condition.round_trip_s or 0.0
        run_s = times.run_s if times.run_s is not None else max(0.0, times.seconds - rtt_s)
        if self.remote and times.run_s is not None:
            beyond_s = max(0.0, times.seconds - (times.queue_s or 0.0) - run_s - rtt_s)
            self._learn_network(moved, beyond_s, rtt_s, bound=times.bound, ahead=ahead)
        self._learn_run(amount, run_s, condition, ahead)

    def learn_late(
        self, amount: float, moved: float, seconds: float, condition: Condition, ahead: int = 1
    ) -> None:
        """A run was given up after these seconds, which are more than predicted."""
        if not self.remote:
            self._learn_run(amount, seconds, condition, ahead)
        else:
            rtt_s = condition.round_trip_s or 0.0
            rest_s = self._run_s(amount, condition) + self._queue_s(condition) + rtt_s
            self._learn_network(moved, max(0.0, seconds - rest_s), rtt_s, bound=False, ahead=ahead)

    def _run_s(self, amount: float, condition: Condition) -> float:
        seconds = self.run.at(amount / self._amount if self._amount else 0.0) / condition.capacity
        load = condition.server_load if self.remote else condition.load
        return seconds * (self.slow or 1.0 + load) if load > LOADED else seconds

    def _network_s(self, moved: float, condition: Condition) -> float:
        beyond_s = self.network.at(moved / self._bytes if self._bytes else 0.0)
        return (condition.round_trip_s or 0.0) + beyond_s

    def _queue_s(self, condition: Condition) -> float:
        return condition.queue * self._usual_run.value

    def _learn_run(self, amount: float, run_s: float, condition: Condition, ahead: int) -> None:
        self._amount = self._amount or amount
        x = amount / self._amount if self._amount else 0.0
        alone_s = run_s * condition.capacity
        load = condition.server_load if self.remote else condition.load
        self._usual_run.add(run_s)
        if load > LOADED and self.run.count >= SLOW_AFTER:
            expected_s = self.run.at(x)
            if expected_s > 0:
                slow = alone_s / expected_s
                self.slow = (
                    self.slow + SLOW_RATE * (min(slow, 3 * self.slow) - self.slow) if self.slow else slow
                )
        else:
            self.run.learn(x, alone_s, ahead=ahead)

    def _learn_network(
        self, moved: float, beyond_s: float, rtt_s: float, *, bound: bool, ahead: int
    ) -> None:
        if not self._bytes:
            self._bytes = moved
            self.network.slope = moved / FIRST_RATE
        x = moved / self._bytes if self._bytes else 0.0
        if bound:
            self.network.bound(x, beyond_s, rtt_s)
        else:
            self.network.learn(x, beyond_s, rtt_s, ahead)
        self._usual_delay.add(self.network.a)

    def _heed(self, round_trip_s: float | None) -> None:
        """A heartbeat shows a new round trip: it may explain what the last answers took beyond the old one."""
        before_s, self._round_trip_s = self._round_trip_s, round_trip_s
        if before_s is None or round_trip_s is None or before_s == round_trip_s or not self.network.count:
            return
        moved_s, odd_s = round_trip_s - before_s, self.network.a - self._usual_delay.value
        if moved_s * odd_s > 0:
            self.network.a -= math.copysign(min(abs(moved_s), abs(odd_s)), odd_s)


def make_parts(window: int, seed: int = 0) -> Parts:
    return Parts(remote=True)
