"""The parts model: a task spends time on the network, in a queue and in its run; each is learned apart.

A reply says how long the task waited and ran at the server, so the network took the rest. `line` is what a
part is learned with; `learning/site.py` decides which executions say anything.
"""

import math

from offboard.common.host.load import LOADED
from offboard.robot_client.predictors.base import WARM_UP, Prediction, check_observation
from offboard.robot_client.predictors.line import Line, RunningMean
from offboard.robot_client.sites.runner import UNMEASURED, Condition

FIRST_BYTES_S = 12.5e6  # bytes a second of a link, until its first answers tell: 100 Mbit/s
SLOW_RATE = 0.3  # loads are rare and short, so the factor under load is learned from few tasks
SLOW_MAX = 3.0  # times the factor known: a run that is slower counts as this slow
CPU_SHARE = 0.5  # of its time that a task must use a CPU, so that its CPU time says how much work it is


class Parts:
    """The model of one kind of task on one site.

    Without the parts of a time, all beyond the round trip counts as the run. Amounts and bytes are learned in
    units of the first ones, so that the numbers of all kinds are near 1.

    `remote`: there is a network between the robot and this site.
    """

    def __init__(self, window: int = 0, seed: int = 0, *, remote: bool = False) -> None:  # noqa: ARG002
        self.remote = remote
        self._run = Line(together=True)
        self._network = Line(together=False)
        # Times that a run takes longer than its work: usually, and under load (0: unknown).
        self._usual_slow = RunningMean()
        self._slow = 0.0
        self._by_cpu: bool | None = None  # whether the work of a run is its CPU time; None: not known yet
        self._usual_run = RunningMean()
        self._usual_delay = RunningMean()
        self._amount = self._bytes = 0.0  # the units
        self._round_trip_s: float | None = None

    @property
    def full(self) -> bool:
        return self._run.count >= WARM_UP

    def __len__(self) -> int:
        return self._run.count

    def predict(
        self,
        size: float,
        ahead: int = 1,  # noqa: ARG002 - the lines do not drift, they only become less certain
        *,
        moved: float = 0.0,
        condition: Condition = UNMEASURED,
    ) -> Prediction | None:
        """The time of a task that moves this many bytes; None before the first run."""
        if not self._run.count:
            return None
        run_s = self._run_s(size, condition)
        seconds, spread_s = run_s * (1.0 + self._run.tail), self._run.deviation * run_s
        if not self.remote:
            return Prediction(seconds, spread_s)
        self._heed(condition.round_trip_s)
        rtt_s = condition.round_trip_s or 0.0
        network_s = rtt_s + self._network.at(moved / self._bytes if self._bytes else 0.0)
        seconds += network_s * (1.0 + self._network.tail) + condition.queue * self._usual_run.value
        return Prediction(seconds, math.hypot(spread_s, self._network.deviation * network_s))

    def learn(
        self,
        size: float,
        seconds: float,
        ahead: int = 1,
        *,
        run_s: float | None = None,
        queue_s: float | None = None,
        moved: float = 0.0,
        bound: bool = False,
        own_cpu_s: float | None = None,
        condition: Condition = UNMEASURED,
    ) -> None:
        """A task took `seconds`, of which it waited `queue_s` and ran `run_s` (None: the site did not say).

        With `bound` the robot may have read the answer late, so the network took at most the rest.
        """
        check_observation(size, seconds)
        rtt_s = condition.round_trip_s or 0.0
        if run_s is None or not self.remote:  # onboard, a busy CPU also makes the run begin late
            run_s = max(0.0, seconds - rtt_s)
        else:
            rest_s = seconds - (queue_s or 0.0) - run_s - rtt_s
            self._learn_network(moved, max(0.0, rest_s), rtt_s, ahead, bound=bound)
        self._learn_run(size, run_s, condition, ahead, own_cpu_s=own_cpu_s)

    def learn_late(
        self, size: float, seconds: float, ahead: int, *, moved: float, condition: Condition
    ) -> None:
        """A run was given up after these seconds, which are more than predicted."""
        if not self.remote:
            self._learn_run(size, seconds, condition, ahead)
            return
        rtt_s = condition.round_trip_s or 0.0
        expected_s = self._run_s(size, condition) + condition.queue * self._usual_run.value
        self._learn_network(moved, max(0.0, seconds - expected_s - rtt_s), rtt_s, ahead, bound=False)

    def _run_s(self, size: float, condition: Condition) -> float:
        seconds = self._run.at(size / self._amount if self._amount else 0.0) / condition.capacity
        load, usual = self._load(condition), self._usual_slow.value or 1.0
        return seconds * (self._slow or usual * (1.0 + load) if load > LOADED else usual)

    def _load(self, condition: Condition) -> float:
        return condition.server_load if self.remote else condition.load

    def _learn_run(
        self, size: float, run_s: float, condition: Condition, ahead: int, *, own_cpu_s: float | None = None
    ) -> None:
        """Learn the work of a run, and how much longer than its work it took.

        The work is the CPU time, where the process knows its own and is not waiting for something else;
        another program does not change it. Otherwise it is the time of a run without load.
        """
        self._usual_run.add(run_s)
        self._amount = self._amount or size
        x = size / self._amount if self._amount else 0.0
        alone_s = run_s * condition.capacity
        loaded = self._load(condition) > LOADED and self.full
        if self._by_cpu is None:
            self._by_cpu = own_cpu_s is not None and own_cpu_s >= CPU_SHARE * alone_s
        if self._by_cpu and own_cpu_s:
            self._run.learn(x, own_cpu_s, ahead=ahead)
            self._learn_slow(alone_s / own_cpu_s, loaded=loaded)
        elif not loaded:
            self._run.learn(x, alone_s / (self._usual_slow.value or 1.0), ahead=ahead)
        elif (expected_s := self._run.at(x)) > 0:
            self._learn_slow(alone_s / expected_s, loaded=loaded)

    def _learn_slow(self, slow: float, *, loaded: bool) -> None:
        if not loaded:
            usual = self._usual_slow.value
            self._usual_slow.add(min(slow, SLOW_MAX * usual) if usual else slow)
        elif self._slow:
            self._slow += SLOW_RATE * (min(slow, SLOW_MAX * self._slow) - self._slow)
        else:
            self._slow = slow

    def _learn_network(self, moved: float, rest_s: float, rtt_s: float, ahead: int, *, bound: bool) -> None:
        if not self._bytes:
            self._bytes = moved
            self._network.slope = moved / FIRST_BYTES_S
        x = moved / self._bytes if self._bytes else 0.0
        if bound:
            self._network.bound(x, rest_s, rtt_s)
        else:
            self._network.learn(x, rest_s, rtt_s, ahead)
        self._usual_delay.add(self._network.a)

    def _heed(self, round_trip_s: float | None) -> None:
        """A new round trip may explain what the last answers took beyond the old one: count it only once."""
        before_s, self._round_trip_s = self._round_trip_s, round_trip_s
        if before_s is None or round_trip_s is None or before_s == round_trip_s or not self._network.count:
            return
        change_s, odd_s = round_trip_s - before_s, self._network.a - self._usual_delay.value
        if change_s * odd_s > 0:
            self._network.a -= math.copysign(min(abs(change_s), abs(odd_s)), odd_s)
