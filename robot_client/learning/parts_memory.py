"""What is known of one kind of task on one site by the parts model (development copy)."""

import math
from collections import deque
from collections.abc import Iterable

from offboard.common.errors import Overtaken, TaskError
from offboard.robot_client.learning.conformal import Conformal
from offboard.robot_client.learning.site import OBSERVATIONS_MAX, Observation, _RunningMean
from offboard.robot_client.policies.energy import Energy
from offboard.robot_client.policies.forecast import Outlook
from offboard.robot_client.policies.objectives import Expected, Objective
from offboard.robot_client.predictors.parts import Parts, Times
from offboard.robot_client.sites.runner import ONBOARD, UNMEASURED, Condition, Execution

WARM_UP = 6


class PartsMemory:
    conditional = True
    parts = True

    def __init__(self, site: str, objective: Objective, energy: Energy) -> None:
        self.predictor = Parts(remote=site != ONBOARD)
        self.age = 0
        self.tasks_since = 0
        self.observations: deque[Observation] = deque(maxlen=OBSERVATIONS_MAX)
        self._site = site
        self._failures = 0
        self._conformal = Conformal()
        self._objective = objective
        self._energy = energy
        self._bytes = _RunningMean()
        self._bytes_in = _RunningMean()
        self._cpu_s = _RunningMean()

    def outlook(self, amount, condition, *, in_flight, timeout_s, bytes_out=None):
        full = len(self.predictor) >= WARM_UP
        moved = self._bytes.value if bytes_out is None else bytes_out + self._bytes_in.value
        found = None if amount is None else self.predictor.predict(amount, moved, condition)
        if found is None:
            return Outlook(
                full=full, age=self.age, failures=self._failures, in_flight=in_flight, condition=condition
            )
        seconds = found.seconds + condition.wait_s
        if condition.silent:
            seconds = max(seconds, timeout_s)
        low_s, high_s = self._conformal.interval(seconds, found.spread_s) or (None, None)
        joules, errors = self._joules(seconds), self._conformal.errors
        return Outlook(
            predicted_s=seconds,
            spread_s=found.spread_s,
            full=full,
            age=self.age,
            failures=self._failures,
            observations=len(self.predictor),
            low_s=low_s,
            high_s=high_s,
            cost=self._objective.cost(Expected(seconds, found.spread_s, joules), errors),
            in_flight=in_flight,
            bytes=moved,
            joules=joules,
            condition=condition,
            errors=errors,
        )

    def count_run(self):
        ahead, self.tasks_since, self.age = max(1, self.tasks_since), 0, 0
        return ahead

    def learn(
        self, amount, execution, outlook, *, silent, size, work=None, beside=False, ahead=None
    ):
        expected_s = outlook.predicted_s if outlook else None
        overtaken = isinstance(execution.failure, Overtaken)
        moved = execution.bytes_out + execution.bytes_in
        if overtaken and execution.seconds <= (expected_s or 0.0):
            return
        if ahead is None:
            ahead = self.count_run()
        if isinstance(execution.failure, TaskError):
            return
        if not overtaken:
            self._failures = 0 if execution.ok else self._failures + 1
        condition = outlook.condition if outlook else UNMEASURED
        late = not execution.ok
        if amount is None or (
            late
            and (
                silent
                or not execution.censored
                or expected_s is None
                or execution.seconds < expected_s
            )
        ):
            return
        behind = self._site == ONBOARD and outlook is not None and outlook.in_flight > 0
        waited_s = (execution.queue_s or 0.0) if behind else 0.0
        past = outlook is not None and outlook.high_s is not None and execution.seconds > outlook.high_s
        held_up = condition.silent or (self._site != ONBOARD and condition.wait_s > 0)
        to_interval = not beside and not held_up and (execution.ok or (execution.censored and past))
        self._take(
            Observation(
                size=size,
                amount=amount,
                work=work,
                seconds=max(0.0, execution.seconds - waited_s),
                ok=execution.ok,
                condition=condition,
                predicted_s=expected_s if to_interval else None,
                waited_s=waited_s,
                bytes=moved,
                cpu_s=execution.cpu_s,
                ahead=ahead,
                run_s=execution.run_s if execution.ok else None,
                queue_s=execution.queue_s if execution.ok else None,
                bound=beside,
                late=late,
            ),
            execution.bytes_in,
        )

    def recall(self, observations: Iterable[Observation], *, age: int) -> None:
        for one in observations:
            self._failures = 0 if one.ok else self._failures + 1
            self._take(one, 0)
        self.age = age

    def joules(self, execution: Execution) -> float:
        if self._site == ONBOARD:
            return self._energy.onboard_j(execution.cpu_s or execution.run_s or execution.seconds)
        return self._energy.remote_j(execution.seconds, execution.bytes_out + execution.bytes_in)

    def _take(self, one: Observation, bytes_in: float) -> None:
        self.observations.append(one)
        if one.ok:
            self._bytes.add(one.bytes)
            self._bytes_in.add(bytes_in)
        if one.cpu_s is not None:
            self._cpu_s.add(one.cpu_s)
        if one.predicted_s is not None and one.ok:
            self._conformal.learn(one.predicted_s, one.seconds + one.waited_s)
        elif one.predicted_s is not None:
            self._conformal.miss()
        if one.late:
            self.predictor.learn_late(one.amount, one.bytes, one.seconds, one.condition, one.ahead)
        else:
            times = Times(one.seconds, one.run_s, one.queue_s, one.bound)
            self.predictor.learn(one.amount, one.bytes, times, one.condition, one.ahead)

    def _joules(self, seconds: float) -> float:
        if self._site == ONBOARD:
            return self._energy.onboard_j(self._cpu_s.value or seconds)
        return self._energy.remote_j(seconds, self._bytes.value)
