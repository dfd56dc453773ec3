"""What is known of one kind of task on one site: its predictor, its errors, its age and its failures.

What all sites of a kind share is in `kind`.
"""

import math
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from offboard.common.errors import Overtaken, TaskError
from offboard.common.host.load import LOADED
from offboard.robot_client.learning.conformal import Conformal
from offboard.robot_client.learning.under_load import UnderLoad
from offboard.robot_client.policies.energy import Energy
from offboard.robot_client.policies.forecast import Outlook
from offboard.robot_client.policies.objectives import Expected, Objective
from offboard.robot_client.predictors import Prediction, Predictor
from offboard.robot_client.predictors.features import Conditional
from offboard.robot_client.sites.own_cpu import may_be_late
from offboard.robot_client.sites.runner import ONBOARD, UNMEASURED, Condition, Execution

MEAN_FROM = (
    10  # amounts of bytes and CPU seconds: what is usual is their mean; then, old amounts fade from it
)
OBSERVATIONS_MAX = 200  # of one site, kept for `store`
SMALL = 0.5  # of the smallest amount that a site ran: the prediction for less is a guess
LOADED_FROM = 10  # observations: times under load are learnt apart only after these
WAYS_MAX = 4  # the shortest of the last ways there and back says how long the way takes


@dataclass(slots=True)
class Observation:
    """What one execution taught its site, with all that is needed to learn it again.

    `amount`: what the predictor learnt `seconds` for: the size or the work.
    `work`: the work that the result said.
    `seconds`: the time without `waited_s`, the wait for other tasks of this robot.
    `predicted_s`: the prediction, if the interval learnt its error.
    `ahead`: how many tasks after the site's previous run this one came.
    """

    size: float
    amount: float
    work: float | None
    seconds: float
    ok: bool
    condition: Condition = UNMEASURED
    predicted_s: float | None = None
    waited_s: float = 0.0
    bytes: float = 0.0
    cpu_s: float | None = None
    ahead: int = 1
    run_s: float | None = None
    queue_s: float | None = None
    bound: bool = False
    late: bool = False


class SiteMemory:
    """The memory of one kind on one site.

    Times under load (LOADED) are learnt apart from other times, in `UnderLoad`. On a loaded robot, running,
    sending and receiving all slow down, by more than one gain on the load can describe. When the load ends,
    the robot is as fast as before. Under load a round trip measures the robot and not the link, so the last
    round trip without load is used instead. The time that a loaded server takes beyond the round trip is
    learnt apart too.
    """

    def __init__(
        self,
        site: str,
        make: Callable[[], Predictor],
        objective: Objective,
        energy: Energy,
    ) -> None:
        predictor = self.predictor = make()
        self.age = 0  # tasks since the site last ran one
        # Like `age`, but for this process only: recalled times are old enough for a probe, but as certain as
        # they were.
        self.tasks_since = 0
        self.observations: deque[Observation] = deque(maxlen=OBSERVATIONS_MAX)
        self._conditional = predictor if isinstance(predictor, Conditional) else None
        self.conditional = self._conditional is not None
        self._under_load = UnderLoad(onboard=site == ONBOARD)
        self._server_under_load = UnderLoad(onboard=True)
        self._site = site
        self._round_trip_s: float | None = None  # the last one without load
        self._smallest = math.inf  # amount that the site ran
        self._ways: deque[float] = deque(maxlen=WAYS_MAX)  # seconds beyond round trip, queue and run
        self._failures = 0
        self._conformal = Conformal()
        self._objective = objective
        self._energy = energy
        self._bytes = _RunningMean()
        self._cpu_s = _RunningMean()

    def outlook(
        self, amount: float | None, condition: Condition, *, in_flight: int, timeout_s: float
    ) -> Outlook:
        """The outlook for a task of this amount; None: the amount is not known yet."""
        predictor, found = self.predictor, None
        if amount is not None:
            if self._conditional is not None:
                found = self._foresee(self._conditional, amount, condition)
            else:
                found = predictor.predict(amount, self.age + 1)
        if found is None:
            return Outlook(
                full=predictor.full,
                age=self.age,
                failures=self._failures,
                in_flight=in_flight,
                condition=condition,
            )
        seconds = found.seconds + condition.wait_s
        if condition.silent:
            seconds = max(seconds, timeout_s)
        low_s, high_s = self._conformal.interval(seconds, found.spread_s) or (None, None)
        joules, errors = self._joules(seconds), self._conformal.errors
        return Outlook(
            predicted_s=seconds,
            spread_s=found.spread_s,
            full=predictor.full,
            age=self.age,
            failures=self._failures,
            observations=len(predictor),
            low_s=low_s,
            high_s=high_s,
            error_s=found.error_s,
            cost=self._objective.cost(Expected(seconds, found.spread_s, joules), errors),
            in_flight=in_flight,
            bytes=self._bytes.value,
            joules=joules,
            condition=condition,
            errors=errors,
            smallest=amount is not None and amount < SMALL * self._smallest,
        )

    def count_run(self) -> int:
        """The site has run a task; returns how many tasks after its previous run that was."""
        ahead, self.tasks_since, self.age = max(1, self.tasks_since), 0, 0
        return ahead

    def learn(
        self,
        amount: float | None,
        execution: Execution,
        outlook: Outlook | None,
        *,
        silent: bool,
        size: float,
        work: float | None = None,
        beside: bool = False,
        ahead: int | None = None,
    ) -> None:
        """Learn from an execution; `outlook` is what was expected of it, and `amount` what it was asked for.

        A failed run is learnt as the time until it was given up: the one addition to Algorithm 1. For a
        predictor of measured features such a time only means that the true time is longer. Then a run that
        failed before its predicted time says nothing, and neither does a failed run while the site is
        `silent`. With `beside`, the robot ran the same task itself and may have received this site's answer
        late, so the time is an upper bound for such a predictor. `ahead` is the value of `count_run`, if that
        was called when the run ended.
        """
        expected_s = outlook.predicted_s if outlook else None
        overtaken = isinstance(execution.failure, Overtaken)
        if overtaken and execution.seconds <= (expected_s or 0.0):
            self._use(execution.bytes_out + execution.bytes_in, execution.cpu_s)
            return  # stopped before its predicted time: the site may be as fast as predicted
        if ahead is None:
            ahead = self.count_run()
        if isinstance(execution.failure, TaskError):
            return
        if not overtaken:  # a run that lost a race did not fail
            self._failures = 0 if execution.ok else self._failures + 1
        condition = outlook.condition if outlook else UNMEASURED
        seconds = self._seconds(amount, execution, condition, expected_s, silent=silent, beside=beside)
        if seconds is None:
            self._use(execution.bytes_out + execution.bytes_in, execution.cpu_s)
            return
        waited_s = self._waited_s(execution, outlook)
        to_interval = not beside and self._tells_of_the_interval(execution, seconds, outlook)
        self._take(
            Observation(
                size=size,
                amount=amount or 0.0,
                work=work,
                seconds=max(0.0, seconds - waited_s),
                ok=execution.ok,
                condition=condition,
                predicted_s=expected_s if to_interval else None,
                waited_s=waited_s,
                bytes=execution.bytes_out + execution.bytes_in,
                cpu_s=execution.cpu_s,
                ahead=ahead,
            )
        )

    def _waited_s(self, execution: Execution, outlook: Outlook | None) -> float:
        """How long an onboard run waited for other tasks of the robot, which its outlook included."""
        behind = self.conditional and self._site == ONBOARD and outlook is not None and outlook.in_flight > 0
        return (execution.queue_s or 0.0) if behind else 0.0

    def recall(self, observations: Iterable[Observation], *, age: int) -> None:
        """Learn observations of an earlier process again, oldest first; the site is then `age` tasks old."""
        for one in observations:
            self._failures = 0 if one.ok else self._failures + 1
            self._take(one)
        self.age = age

    def joules(self, execution: Execution) -> float:
        """What an execution took from the battery, in joules."""
        if self._site == ONBOARD:
            return self._energy.onboard_j(execution.cpu_s or execution.run_s or execution.seconds)
        return self._energy.remote_j(execution.seconds, execution.bytes_out + execution.bytes_in)

    def _seconds(
        self,
        amount: float | None,
        execution: Execution,
        condition: Condition,
        expected_s: float | None,
        *,
        silent: bool,
        beside: bool,
    ) -> float | None:
        """The time that the predictor learns; None if this execution says nothing about it."""
        seconds, model = execution.seconds, self._conditional
        if model is not None:
            if amount is None or not (
                execution.ok or (not silent and _is_longer(execution, seconds, expected_s))
            ):
                return None
            if beside and condition.load <= LOADED:
                return self._seconds_alone(self._unloaded(model, amount, condition), execution, condition)
        if execution.ok and condition.round_trip_s is not None:
            self._ways.append(seconds - _shortest_s(execution, condition))
        return seconds

    def _seconds_alone(
        self, found: Prediction | None, execution: Execution, condition: Condition
    ) -> float | None:
        """The time an execution would have taken if the robot had not run the task too; None: unknown.

        It is estimated with the shortest of the last ways there and back, as clocks are set (RFC 5905, clock
        filter), unless the answer is so late that there must be another reason. Without heartbeats the time
        is an upper bound.
        """
        seconds, shortest_s = execution.seconds, _shortest_s(execution, condition)
        if not execution.ok:
            return seconds
        if condition.round_trip_s is not None:
            self._ways.append(seconds - shortest_s)
        if found is not None and not may_be_late(seconds, found.seconds):
            return seconds
        if condition.round_trip_s is not None:
            return shortest_s + max(0.0, min(self._ways))
        if found is None or seconds < found.seconds:
            return seconds
        return None if shortest_s <= found.seconds else shortest_s

    def _tells_of_the_interval(self, execution: Execution, seconds: float, outlook: Outlook | None) -> bool:
        """Whether the interval learns from this execution: an outage is no error of a prediction."""
        condition = outlook.condition if outlook else UNMEASURED
        if condition.silent or (self._site != ONBOARD and condition.wait_s > 0):
            return False
        past = outlook is not None and outlook.high_s is not None and seconds > outlook.high_s
        return execution.ok or (execution.censored and past)

    def _take(self, one: Observation) -> None:
        self.observations.append(one)
        if one.amount < self._smallest:
            self._smallest = one.amount
        self._use(one.bytes, one.cpu_s)
        if one.predicted_s is not None and one.ok:
            self._conformal.learn(one.predicted_s, one.seconds + one.waited_s)
        elif one.predicted_s is not None:
            self._conformal.miss()
        if self._conditional is None:
            self.predictor.learn(one.amount, one.seconds)
        else:
            self._learn_measured(self._conditional, one)

    def _learn_measured(self, model: Conditional, one: Observation) -> None:
        """Teach a predictor of measured features; times under load are learnt apart."""
        condition, many = one.condition, len(self.predictor) >= LOADED_FROM
        way_s = condition.round_trip_s or 0.0
        if many and condition.load > LOADED:
            found = self._unloaded(model, one.amount, self._without_load(condition))
            if found is not None:
                self._under_load.learn(found.seconds, one.seconds)
        elif many and condition.server_load > LOADED:
            alone = self._seen(condition._replace(server_load=0.0))
            found = _predict_at_capacity(model, one.amount, 1, alone)
            if found is not None:
                alone_s, took_s = (max(0.0, seconds - way_s) for seconds in (found.seconds, one.seconds))
                self._server_under_load.learn(alone_s, took_s)
        else:
            computing_s = max(0.0, one.seconds - way_s)  # the part that the capacity slows down
            seconds = one.seconds - computing_s * (1.0 - condition.capacity)
            model.learn(one.amount, seconds, self._seen(condition), one.ahead)

    def _foresee(self, model: Conditional, amount: float, condition: Condition) -> Prediction | None:
        loaded = condition.load > LOADED
        if not loaded:
            self._round_trip_s = condition.round_trip_s
        elif self._under_load.known:
            found = self._unloaded(model, amount, self._without_load(condition))
            return found and found._replace(seconds=self._under_load.expect(found.seconds))
        return self._unloaded(model, amount, condition)

    def _unloaded(self, model: Conditional, amount: float, condition: Condition) -> Prediction | None:
        """The prediction with the load of the server, but without what this robot's load adds."""
        if condition.server_load <= LOADED or not self._server_under_load.known:
            return _predict_at_capacity(model, amount, self.tasks_since + 1, self._seen(condition))
        alone = self._seen(condition._replace(server_load=0.0))
        found = _predict_at_capacity(model, amount, self.tasks_since + 1, alone)
        if found is None:
            return None
        way_s = condition.round_trip_s or 0.0
        alone_s = max(0.0, found.seconds - way_s)
        return found._replace(seconds=way_s + self._server_under_load.expect(alone_s))

    def _without_load(self, condition: Condition) -> Condition:
        """The condition as it would be if the robot were not loaded."""
        return condition._replace(load=0.0, round_trip_s=self._round_trip_s or condition.round_trip_s)

    def _seen(self, condition: Condition) -> Condition:
        """The condition as predictors read it: `load` is the load of the site's own CPU."""
        load = condition.load if self._site == ONBOARD else condition.server_load
        return condition if condition.load == load else condition._replace(load=load)

    def _use(self, moved: float, cpu_s: float | None) -> None:
        self._bytes.add(moved)
        if cpu_s is not None:
            self._cpu_s.add(cpu_s)

    def _joules(self, seconds: float) -> float:
        if self._site == ONBOARD:
            return self._energy.onboard_j(self._cpu_s.value or seconds)
        return self._energy.remote_j(seconds, self._bytes.value)


def _shortest_s(execution: Execution, condition: Condition) -> float:
    """No answer can come sooner than after the server's queue and run, and a round trip."""
    return (condition.round_trip_s or 0.0) + (execution.queue_s or 0.0) + (execution.run_s or 0.0)


def _predict_at_capacity(
    model: Conditional, amount: float, ahead: int, condition: Condition
) -> Prediction | None:
    """The model predicts for a whole CPU; with half of it, all but the round trip takes twice as long."""
    found, capacity = model.predict(amount, ahead, condition), condition.capacity
    if found is None or capacity == 1.0:
        return found
    seconds, spread_s, error_s = found
    way_s = condition.round_trip_s or 0.0
    return Prediction(
        way_s + max(0.0, seconds - way_s) / capacity,
        None if spread_s is None else spread_s / capacity,
        None if error_s is None else error_s / capacity,
    )


def _is_longer(execution: Execution, seconds: float, expected_s: float | None) -> bool:
    """Whether a failed run shows that the site takes longer than predicted."""
    return execution.censored if expected_s is None else seconds >= expected_s


class _RunningMean:
    """The mean of the first amounts, then one in which old amounts fade."""

    __slots__ = ("_count", "value")

    def __init__(self) -> None:
        self.value = 0.0
        self._count = 0

    def add(self, amount: float) -> None:
        if math.isfinite(amount):
            if self._count < MEAN_FROM:
                self._count += 1
            self.value += (amount - self.value) / self._count
