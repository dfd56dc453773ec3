"""The parts model: a task spends time on the network, in a queue and in its run; each is learned apart.

A reply says how long the task waited and ran at the server, so the network took the rest. `line` is what a
part is learned with; `learning/site.py` decides which executions say anything.
"""

import math

from offboard.common.load import LOADED
from offboard.common.tasks import first_number
from offboard.robot_client.predictors.base import WARM_UP, Call, Prediction, Run, check_observation
from offboard.robot_client.predictors.line import Line, RunningMean
from offboard.robot_client.sites.runner import Condition

LEAST = 0.25  # of its standard error: no run is predicted to be shorter, so that it is never a certain 0
FIRST_BYTES_S = 12.5e6  # bytes a second of a link, until its first answers tell: 100 Mbit/s


class Parts:
    """The model of one kind of task on one site.

    Without the parts of a time, all beyond the round trip counts as the run. Amounts and bytes are learned in
    units of the first ones, so that the numbers of all kinds are near 1.

    `remote`: there is a network between the robot and this site.
    """

    LINE = Line  # what learns each part
    learns_failures = False
    per_work = True  # amounts are the work of tasks, of kinds whose results tell it

    def __init__(self, window: int = 0, seed: int = 0, *, remote: bool = False) -> None:  # noqa: ARG002 - no window
        self.remote = remote
        self._run = self.LINE(together=True)
        self._network = self.LINE(together=False)
        self._loaded = self.LINE(together=True)  # runs while other programs take the CPU
        self._usual_run = RunningMean()
        self._wait_error = RunningMean()  # of what a server says that tasks will wait
        self._amount = self._bytes = 0.0  # the units

    def at_site(self, *, remote: bool) -> "Parts":
        """The same model, for a site behind a network, or for onboard."""
        self.remote = remote
        return self

    @property
    def full(self) -> bool:
        return self._run.count >= WARM_UP

    def __len__(self) -> int:
        return self._run.count

    @property
    def byte_s(self) -> float | None:
        """The most seconds, by what is known, that each byte takes on the link; None onboard.

        The upper end makes the robot try to send less: equal tasks do not tell what their bytes take.
        """
        if not self.remote:
            return None
        if not (self._bytes and self._network.count):
            return 1.0 / FIRST_BYTES_S
        return self._network.steepest / self._bytes

    def predict(self, call: Call) -> Prediction | None:
        if not self._run.count:
            return None
        condition = call.condition
        run_s, error_s = self._run_s(first_number(call.amount), condition)
        seconds, spread_s = run_s * (1.0 + self._run.tail), self._run.deviation * run_s
        if not self.remote:
            return Prediction(seconds, spread_s, error_s)
        x = call.moved / self._bytes if self._bytes else 0.0
        network_s = (condition.round_trip_s or 0.0) + self._network.at(x)
        seconds += network_s * (1.0 + self._network.tail)
        seconds += self._waits_s(condition) if condition.queue_s else condition.queue * self._usual_run.value
        spread_s = math.hypot(spread_s, self._network.deviation * network_s)
        return Prediction(seconds + call.pack_s, spread_s, math.hypot(error_s, self._network.error(x)))

    def learn(self, call: Call, run: Run) -> None:
        """A reply says how long the task waited and ran; of one that did not end, only that it took longer.

        With `run.bound` the robot may have read the answer late, so the network took at most the rest.
        """
        size, condition, seconds, run_s = first_number(call.amount), call.condition, run.seconds, run.run_s
        check_observation(size, seconds)
        rtt_s = condition.round_trip_s or 0.0
        if not run.ended:
            if not (self.remote and self._network.count):  # onboard, or a server that does not tell the parts
                self._learn_run(size, seconds, condition)
                return
            expected_s = self._run_s(size, condition)[0] + self._waits_s(condition)
            self._learn_network(call.moved, max(0.0, seconds - expected_s - rtt_s), rtt_s, bound=False)
            return
        if run_s is None or not self.remote:  # onboard, a busy CPU also makes the run begin late
            run_s = max(0.0, seconds - rtt_s)
        else:
            rest_s = seconds - (run.queue_s or 0.0) - run_s - rtt_s
            self._learn_network(call.moved, max(0.0, rest_s), rtt_s, bound=run.bound)
            if condition.queue_s:
                self._wait_error.add((run.queue_s or 0.0) - condition.queue_s)
        self._learn_run(size, run_s, condition)

    def _waits_s(self, condition: Condition) -> float:
        """The wait in the queue: what the server expects and how far off that was, or usual runs."""
        if condition.queue_s:
            return max(0.0, condition.queue_s + self._wait_error.value)
        return condition.queue * self._usual_run.value

    def _run_s(self, size: float, condition: Condition) -> tuple[float, float]:
        """The seconds of a run, and their standard error, which alone is known where the line is below 0."""
        x, load = size / self._amount if self._amount else 0.0, self._load(condition)
        line, capacity = self._run, condition.capacity
        if load > LOADED:
            if self._loaded.count:
                line = self._loaded
            else:
                capacity /= 1.0 + load
        error_s = line.error(x)
        return max(line.at(x), LEAST * error_s) / capacity, error_s / capacity

    def _load(self, condition: Condition) -> float:
        return condition.server_load if self.remote else condition.load

    def _learn_run(self, size: float, run_s: float, condition: Condition) -> None:
        """Learn a run, apart from others if other programs take the CPU.

        Under load, a run waits for the CPU several times, which depends little on its work. So the factor
        between loaded and other runs is not the same for all of them.
        """
        self._usual_run.add(run_s)
        self._amount = self._amount or size
        x, alone_s = size / self._amount if self._amount else 0.0, run_s * condition.capacity
        if self._load(condition) <= LOADED or not self.full:
            self._run.learn(x, alone_s)
        elif not self._loaded.count and self._run.at(x) > 0:
            self._loaded.begin_as(self._run, x, alone_s)
        else:
            self._loaded.learn(x, alone_s)

    def _learn_network(self, moved: float, rest_s: float, rtt_s: float, *, bound: bool) -> None:
        self._bytes = self._bytes or moved
        x = moved / self._bytes if self._bytes else 0.0
        if bound:
            self._network.bound(x, rest_s, rtt_s)
        else:
            self._network.learn(x, rest_s, rtt_s)
