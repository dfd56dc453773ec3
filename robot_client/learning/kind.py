"""What is known of one kind of task: the work of its sizes, and its times on every site.

Which site is taken for it is the business of `policies`.
"""

import logging
import math
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from offboard.common.errors import Overtaken, TaskError
from offboard.common.host.load import LOADED
from offboard.common.tasks import Kind
from offboard.robot_client.learning.conformal import Conformal
from offboard.robot_client.learning.shared_work import SharedWork
from offboard.robot_client.learning.under_load import UnderLoad
from offboard.robot_client.policies.energy import Energy
from offboard.robot_client.policies.forecast import Outlook
from offboard.robot_client.policies.objectives import Expected, Objective
from offboard.robot_client.predictors import Prediction, Predictor
from offboard.robot_client.predictors.features import Conditional
from offboard.robot_client.sites.own_cpu import may_be_late
from offboard.robot_client.sites.runner import ONBOARD, UNMEASURED, Condition, Execution

AMOUNT_RATE = 0.1  # of the bytes and CPU seconds that a task usually takes
OBSERVATIONS_MAX = 200  # of a site, kept for `store`
SMALL = 0.5  # of the least that a site ran: below it a prediction is a guess
LOADED_FROM = 10  # times of a site: the first ones are all learnt as one
WAY_LEAST_OF = 4  # answers: the one that was on its way for the shortest tells how long the way is

log = logging.getLogger(__name__)


@dataclass(slots=True)
class Observation:
    """What one execution taught its site, and all that is needed to teach it again.

    `amount`: what the predictor learnt `seconds` for, the size, or the work, which `work` is where a result
    told it; `waited_s` of the run's time were left out of them; `predicted_s`: what the interval learnt from;
    `ahead`: so many tasks after the one before.
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


class KindMemory:
    """Of one kind. `make` makes the predictor of a site; with `shared_work` sites learn seconds per work."""

    def __init__(
        self,
        kind: Kind,
        make: Callable[[], Predictor],
        *,
        objective: Objective,
        energy: Energy,
        shared_work: bool,
    ) -> None:
        self.sites: dict[str, SiteMemory] = {}
        self.last_site: str | None = None
        self.worked: deque[tuple[float, float]] = deque(maxlen=OBSERVATIONS_MAX)  # sizes and their work
        self.kind = kind
        self._make = make
        self._objective = objective
        self._energy = energy
        self._work = SharedWork() if shared_work and kind.work is not None else None

    @property
    def per_work(self) -> bool:
        """Whether sites learn seconds per work; else per size."""
        return self._work is not None

    def site(self, name: str) -> "SiteMemory":
        if name not in self.sites:
            self.sites[name] = SiteMemory(name, self._make, self._objective, self._energy)
        return self.sites[name]

    def amount(self, size: float) -> float | None:
        """What the predictors are asked with: the work to expect of a size, the size where none is told."""
        return size if self._work is None else self._work.predict(size)

    def work_of(self, execution: Execution) -> float | None:
        """The work that the execution's result says it was."""
        if self._work is None or not execution.ok:
            return None
        try:
            return self.kind.work_of(execution.value)
        except Exception:  # the function is the user's own
            log.exception("the work of a result of task %s cannot be told", self.kind.name)
            return None

    def work_told(self, executions: Iterable[Execution]) -> float | None:
        """The work that a task was, where a result of it says so."""
        return next((work for one in executions if (work := self.work_of(one)) is not None), None)

    def learn_size(self, size: float, work: float) -> None:
        """A task of this size was so much work."""
        if self._work is not None:
            self._work.learn(size, work)
            self.worked.append((size, work))

    def pass_by(self) -> None:
        """One more task of this kind, wherever it runs."""
        for memory in self.sites.values():
            memory.age += 1
            memory.untold += 1


class SiteMemory:
    """Of one kind on one site.

    What it takes while the robot is LOADED is learnt apart: the robot is slow to run, to send and to hear
    then, by more than a gain on the load tells, and everything is as quick as before once that is over. A
    server's round trip tells of the robot then, and is taken to be what it was before. What a server takes
    beyond the round trip while it is LOADED itself is learnt apart too.
    """

    def __init__(
        self,
        site: str,
        make: Callable[[], Predictor],
        objective: Objective,
        energy: Energy,
    ) -> None:
        predictor = self.predictor = make()
        self.age = 0
        self.untold = 0  # the same, of this process alone: what is recalled is stale, but not feared the less
        self.observations: deque[Observation] = deque(maxlen=OBSERVATIONS_MAX)
        self._conditional = predictor if isinstance(predictor, Conditional) else None
        self.conditional = self._conditional is not None
        self._under_load = UnderLoad(onboard=site == ONBOARD)
        self._server_under_load = UnderLoad(onboard=True)
        self._site = site
        self._round_trip_s: float | None = None  # the last one without load
        self._least = math.inf  # amount that it ran
        self._ways: deque[float] = deque(maxlen=WAY_LEAST_OF)  # seconds beyond round trip, queue and run
        self._failures = 0
        self._conformal = Conformal()
        self._objective = objective
        self._energy = energy
        self._bytes = _Usual()
        self._cpu_s = _Usual()

    def outlook(
        self, amount: float | None, condition: Condition, *, in_flight: int, timeout_s: float
    ) -> Outlook:
        """Before a task of so much work, or of this size."""
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
            smallest=amount is not None and amount < SMALL * self._least,
        )

    def _foresee(self, model: Conditional, amount: float, condition: Condition) -> Prediction | None:
        loaded = condition.load > LOADED
        if not loaded:
            self._round_trip_s = condition.round_trip_s
        elif self._under_load.known:
            found = self._unloaded(model, amount, self._quiet(condition))
            return found and found._replace(seconds=self._under_load.expect(found.seconds))
        return self._unloaded(model, amount, condition)

    def _unloaded(self, model: Conditional, amount: float, condition: Condition) -> Prediction | None:
        """But for what others take of a server's CPU, and what `model` knows of loads."""
        if condition.server_load <= LOADED or not self._server_under_load.known:
            return _foretold(model, amount, self.untold + 1, self._seen(condition))
        found = _foretold(model, amount, self.untold + 1, self._seen(condition._replace(server_load=0.0)))
        if found is None:
            return None
        way_s = condition.round_trip_s or 0.0
        alone_s = max(0.0, found.seconds - way_s)
        return found._replace(seconds=way_s + self._server_under_load.expect(alone_s))

    def told(self) -> int:
        """The site ran a task; so many after the one before."""
        ahead, self.untold, self.age = max(1, self.untold), 0, 0
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
        """Take an execution; `outlook` is what was expected of it, `amount` as for `outlook`.

        A failed run is learnt as the time until it was given up: the one addition to Algorithm 1. To a
        predictor of measured features it says that the time is longer: a refusal at once says nothing, nor
        does any failure where the site's heartbeats go unanswered (`silent`). `beside`: the robot ran the
        same task itself, and may have heard late of this site: to such a predictor the time is a bound.
        `ahead`: what `told` said when it ended, where that was before.
        """
        expected_s = outlook.predicted_s if outlook else None
        overtaken = isinstance(execution.failure, Overtaken)
        if overtaken and execution.seconds <= (expected_s or 0.0):
            self._use(execution.bytes_out + execution.bytes_in, execution.cpu_s)
            return  # stopped before it was due: as little is known of the site as before
        if ahead is None:
            ahead = self.told()
        if isinstance(execution.failure, TaskError):
            return
        if not overtaken:  # whoever lost a race did not fail
            self._failures = 0 if execution.ok else self._failures + 1
        condition = outlook.condition if outlook else UNMEASURED
        seconds = execution.seconds
        moved, cpu_s = execution.bytes_out + execution.bytes_in, execution.cpu_s
        tells = execution.ok or (not silent and _longer(execution, seconds, expected_s))
        if self.conditional and (amount is None or not tells):
            self._use(moved, cpu_s)
            return
        behind = self.conditional and self._site == ONBOARD and outlook is not None and outlook.in_flight > 0
        waited_s = (execution.queue_s or 0.0) if behind else 0.0
        if beside and self._conditional is not None and amount is not None and condition.load <= LOADED:
            found = self._unloaded(self._conditional, amount, condition)
            alone_s = self._alone_s(found, execution, condition)
            if alone_s is None:
                self._use(moved, cpu_s)
                return
            seconds = alone_s
        elif execution.ok and condition.round_trip_s is not None:
            self._ways.append(seconds - _least_s(execution, condition))
        held_up = condition.silent or (self._site != ONBOARD and condition.wait_s > 0)
        past = outlook is not None and outlook.high_s is not None and seconds > outlook.high_s
        interval = (execution.ok or (execution.censored and past)) and not held_up and not beside
        self._take(
            Observation(
                size,
                amount or 0.0,
                work,
                max(0.0, seconds - waited_s),
                execution.ok,
                condition,
                expected_s if interval else None,
                waited_s,
                moved,
                cpu_s,
                ahead,
            )
        )

    def _alone_s(self, found: Prediction | None, execution: Execution, condition: Condition) -> float | None:
        """What an execution would have taken had the robot not computed meanwhile; None: nobody knows.

        By the shortest of the last ways there and back, as clocks are set by (RFC 5905, clock filter), unless
        it took so long that it was late for another reason. Without heartbeats it is a bound.
        """
        seconds, least_s = execution.seconds, _least_s(execution, condition)
        if not execution.ok:
            return seconds
        if condition.round_trip_s is not None:
            self._ways.append(seconds - least_s)
        if found is not None and not may_be_late(seconds, found.seconds):
            return seconds
        if condition.round_trip_s is not None:
            return least_s + max(0.0, min(self._ways))
        if found is None or seconds < found.seconds:
            return seconds
        return None if least_s <= found.seconds else least_s

    def recall(self, observations: Iterable[Observation], *, age: int) -> None:
        """Learn again what was learnt before, oldest first; it is as old as `age` tasks."""
        for one in observations:
            self._failures = 0 if one.ok else self._failures + 1
            self._take(one)
        self.age = age

    def _take(self, one: Observation) -> None:
        self.observations.append(one)
        self._least = min(self._least, one.amount)
        self._use(one.bytes, one.cpu_s)
        if one.predicted_s is not None and one.ok:
            self._conformal.learn(one.predicted_s, one.seconds + one.waited_s)
        elif one.predicted_s is not None:
            self._conformal.miss()
        if self._conditional is None:
            self.predictor.learn(one.amount, one.seconds)
        elif one.condition.load > LOADED and len(self.predictor) >= LOADED_FROM:
            found = self._unloaded(self._conditional, one.amount, self._quiet(one.condition))
            if found is not None:
                self._under_load.learn(found.seconds, one.seconds)
        elif one.condition.server_load > LOADED and len(self.predictor) >= LOADED_FROM:
            alone, way_s = one.condition._replace(server_load=0.0), one.condition.round_trip_s or 0.0
            found = _foretold(self._conditional, one.amount, 1, self._seen(alone))
            if found is not None:
                alone_s, took_s = (max(0.0, seconds - way_s) for seconds in (found.seconds, one.seconds))
                self._server_under_load.learn(alone_s, took_s)
        else:
            held_s = max(0.0, one.seconds - (one.condition.round_trip_s or 0.0))  # to that capacity
            seconds = one.seconds - held_s * (1.0 - one.condition.capacity)
            self._conditional.learn(one.amount, seconds, self._seen(one.condition), one.ahead)

    def _quiet(self, condition: Condition) -> Condition:
        """What it would be without the load."""
        return condition._replace(load=0.0, round_trip_s=self._round_trip_s or condition.round_trip_s)

    def _seen(self, condition: Condition) -> Condition:
        """By the predictors, to which a site's load is that of its own CPU."""
        load = condition.load if self._site == ONBOARD else condition.server_load
        return condition if condition.load == load else condition._replace(load=load)

    def _use(self, moved: float, cpu_s: float | None) -> None:
        self._bytes.add(moved)
        if cpu_s is not None:
            self._cpu_s.add(cpu_s)

    def joules(self, execution: Execution) -> float:
        """What an execution took from the battery."""
        if self._site == ONBOARD:
            return self._energy.onboard_j(execution.cpu_s or execution.run_s or execution.seconds)
        return self._energy.remote_j(execution.seconds, execution.bytes_out + execution.bytes_in)

    def _joules(self, seconds: float) -> float:
        if self._site == ONBOARD:
            return self._energy.onboard_j(self._cpu_s.value or seconds)
        return self._energy.remote_j(seconds, self._bytes.value)


def _least_s(execution: Execution, condition: Condition) -> float:
    """The server's part and a round trip: no answer is there sooner."""
    return (condition.round_trip_s or 0.0) + (execution.queue_s or 0.0) + (execution.run_s or 0.0)


def _foretold(model: Conditional, amount: float, ahead: int, condition: Condition) -> Prediction | None:
    """By seconds on a whole CPU: with half of it all takes twice as long, but for the way there and back."""
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


def _longer(execution: Execution, seconds: float, expected_s: float | None) -> bool:
    """Whether a failed run tells that the site takes longer than expected."""
    return execution.censored if expected_s is None else seconds >= expected_s


class _Usual:
    """A running mean of amounts."""

    __slots__ = ("_count", "value")

    def __init__(self) -> None:
        self.value = 0.0
        self._count = 0

    def add(self, amount: float) -> None:
        if math.isfinite(amount):
            self._count = min(self._count + 1, round(1 / AMOUNT_RATE))
            self.value += (amount - self.value) / self._count
