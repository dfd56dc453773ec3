"""What is known of one kind of task on one site: its predictor, its errors, its age and its failures.

What all sites of a kind share is in `kind`; how times are predicted is in `predictors`.
"""

import itertools
import math
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from offboard.common.errors import CannotCross, Overtaken, SiteClosed, TaskError
from offboard.common.tasks import Size, first_number
from offboard.robot_client.learning.conformal import ERRORS_MAX, Conformal
from offboard.robot_client.policies.forecast import Outlook, Packing, Quality
from offboard.robot_client.predictors import Model, Predictor
from offboard.robot_client.predictors.base import REMEMBERED, Call, Run
from offboard.robot_client.predictors.line import RunningMean
from offboard.robot_client.predictors.plain import model_of
from offboard.robot_client.sites.runner import ONBOARD, UNMEASURED, Condition, Execution, Sending

NOT_OF_THE_SITE = (TaskError, CannotCross, SiteClosed)  # failures that say nothing of the site


@dataclass(slots=True)
class Observation:
    """What one execution taught its site, with all that is needed to learn it again.

    `amount`: what the predictor learned `seconds` for: the size or the work.
    `work`: the work that the result said.
    `seconds`: the time without `waited_s`, the wait for other tasks of this robot, or for the packing.
    `predicted_s`: the prediction, if the interval learned its error.
    `run_s`, `queue_s`: what the site measured of them; None: nothing.
    `bound`: the robot ran the same task itself and may have received the answer of this site late.
    """

    size: Size
    amount: Size
    work: float | None
    seconds: float
    ok: bool
    condition: Condition = UNMEASURED
    predicted_s: float | None = None
    waited_s: float = 0.0
    bytes_out: float = 0.0
    bytes_in: float = 0.0
    cpu_s: float | None = None
    run_s: float | None = None
    queue_s: float | None = None
    bound: bool = False


class SiteMemory:
    """The memory of one kind on one site.

    With `measured`, the heartbeats and the load of the site count; without, only the times of its tasks.
    `quality`: of what the site runs.
    """

    def __init__(
        self,
        site: str,
        make: Callable[[], Predictor | Model],
        *,
        measured: bool,
        quality: Quality,
    ) -> None:
        self.model = model_of(make(), remote=site != ONBOARD)
        self.age = 0  # tasks since the site last ran one
        self.observations: deque[Observation] = deque(maxlen=REMEMBERED)
        self.measured = measured
        self._site = site
        self._failures = 0
        self._conformal = Conformal()
        self._quality = quality
        self._bytes_in = RunningMean()
        self._cpu_share = RunningMean()  # CPU seconds in each second of a run

    def outlook(
        self,
        amount: Size | None,
        condition: Condition,
        *,
        in_flight: int,
        under_way: bool = False,
        sending: Sending,
        packing: Packing | None = None,
    ) -> Outlook:
        """The outlook for a task of this amount that sends these bytes, unless `packing` says fewer.

        An amount of None is unknown.
        """
        model = self.model
        moved = (sending.bytes if packing is None else packing.bytes) + self._bytes_in.value
        pack_s = 0.0 if packing is None else packing.seconds
        call = None if amount is None else Call(amount, moved, condition, pack_s, ahead=self.age + 1)
        found = None if call is None else model.predict(call)
        if found is None:
            return Outlook(
                full=model.full,
                age=self.age,
                failures=self._failures,
                in_flight=in_flight,
                under_way=under_way,
                condition=condition,
                quality=self._quality,
                packing=packing,
                sending=sending,
            )
        seconds = found.seconds + condition.wait_s
        spread_s, error_s, quality = found.spread_s, found.error_s or 0.0, self._quality
        low_s, high_s = self._conformal.interval(seconds, spread_s, error_s) or (None, None)
        # All fields in their order: with keywords, it takes three times as long.
        return Outlook._make((
            seconds, spread_s, model.full, self.age, self._failures, len(model),
            low_s, high_s, found.error_s, in_flight, moved, self._cpu_share.value or 1.0, condition,
            self._conformal.errors, quality, packing, sending, under_way, None, 0.0, seconds + quality.lost_s,
        ))  # fmt: skip

    def slowest_s(self, amount: Size | None) -> float:
        """The longest of the last times here, of tasks that were not larger than this amount."""
        most = math.inf if amount is None else first_number(amount)
        last = itertools.islice(reversed(self.observations), ERRORS_MAX)
        return max(
            (one.seconds + one.waited_s for one in last if first_number(one.amount) <= most), default=0.0
        )

    def learn(
        self,
        amount: Size | None,
        execution: Execution,
        outlook: Outlook | None,
        *,
        silent: bool,
        size: Size,
        work: float | None = None,
        bound: bool = False,
    ) -> None:
        """Learn from an execution; `outlook` is what was expected of it, and `amount` what it was asked for.

        A failed run is learned as the time until it was given up: the one addition to Algorithm 1. If the
        model learns no failures, such a time only means that the true time is longer, and a run that failed
        before its predicted time says nothing. A run that failed while the site is `silent` never says
        anything. `bound`: as in `Run`.
        """
        expected_s, ok = outlook.predicted_s if outlook else None, execution.ok
        overtaken = not ok and isinstance(execution.failure, Overtaken)
        if overtaken and execution.seconds <= (expected_s or 0.0):
            return  # stopped before its predicted time: the site may be as fast as predicted
        self.age = 0
        if isinstance(execution.failure, NOT_OF_THE_SITE):
            if isinstance(execution.failure, TaskError) and not execution.started:
                self._failures += 1  # its setup failed: the site is at fault, not the task
            return
        if not overtaken:  # a run that lost a race did not fail
            self._failures = 0 if ok else self._failures + 1
        if amount is None or (not ok and not self._is_longer(execution, expected_s, silent=silent)):
            return
        waited_s = self._waited_s(execution, outlook)
        to_interval = not bound and self._tells_of_the_interval(execution, outlook)
        self._take(
            Observation(
                size=size,
                amount=amount,
                work=work,
                seconds=max(0.0, execution.seconds - waited_s),
                ok=ok,
                condition=outlook.condition if outlook else UNMEASURED,
                predicted_s=expected_s if to_interval else None,
                waited_s=waited_s,
                bytes_out=execution.bytes_out,
                bytes_in=execution.bytes_in,
                cpu_s=execution.cpu_s,
                run_s=execution.run_s,
                queue_s=execution.queue_s,
                bound=bound,
            )
        )

    def recall(self, observations: Iterable[Observation], *, age: int) -> None:
        """Learn observations of an earlier process again, oldest first; the site is then `age` tasks old."""
        for one in observations:
            self._failures = 0 if one.ok else self._failures + 1
            self._take(one)
        self.age = age

    def _is_longer(self, execution: Execution, expected_s: float | None, *, silent: bool) -> bool:
        """Whether a failed run shows that the site takes longer than predicted."""
        if silent or self.model.learns_failures:
            return not silent
        return execution.censored and expected_s is not None and execution.seconds >= expected_s

    def _waited_s(self, execution: Execution, outlook: Outlook | None) -> float:
        """How long the run waited before the site had it, for something that its outlook included.

        Onboard, it waited for other tasks of the robot; on the way to a server, for the packing.
        """
        if execution.packed:
            return execution.pack_s
        behind = self.measured and self._site == ONBOARD and outlook is not None and outlook.in_flight > 0
        return (execution.queue_s or 0.0) if behind else 0.0

    def _tells_of_the_interval(self, execution: Execution, outlook: Outlook | None) -> bool:
        """Whether the interval learns from this execution: an outage is no error of a prediction."""
        if outlook is None:
            return execution.ok
        condition = outlook.condition
        if condition.silent or (self._site != ONBOARD and condition.wait_s > 0):
            return False
        past = outlook.high_s is not None and execution.seconds > outlook.high_s
        return execution.ok or (execution.censored and past)

    def _take(self, one: Observation) -> None:
        self.observations.append(one)
        if one.ok:
            self._bytes_in.add(one.bytes_in)
        if one.cpu_s is not None and one.seconds:
            self._cpu_share.add(one.cpu_s / one.seconds)
        if one.predicted_s is not None and one.ok:
            self._conformal.learn(one.predicted_s, one.seconds + one.waited_s)
        elif one.predicted_s is not None:
            self._conformal.miss(one.predicted_s, one.seconds + one.waited_s)
        pack_s = 0.0 if self._site == ONBOARD else one.waited_s
        run = Run(one.seconds, one.ok, one.run_s, one.queue_s, pack_s=pack_s, bound=one.bound)
        self.model.learn(Call(one.amount, one.bytes_out + one.bytes_in, one.condition), run)
