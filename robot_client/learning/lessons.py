"""What executions teach the memories: what is news at once, the rest by and by, while a task is under way.

A robot with a tenth of a CPU waits ten times as long as it computes between an answer and the next request,
and what it does once a task it does with cold caches.
"""

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from offboard.common.errors import Overtaken
from offboard.common.host.load import LOADED
from offboard.common.tasks import Task
from offboard.robot_client.learning.kind import KindMemory
from offboard.robot_client.learning.regret import RegretEstimate
from offboard.robot_client.policies import Decision, Forecast, Outlook, Probe
from offboard.robot_client.policies.allowance import Allowance
from offboard.robot_client.sites.runner import ONBOARD, Execution, Runner

TOGETHER = 4  # tasks that went as expected are learnt at a time
FREED = 0.5  # of the time that was expected: a robot that is so quick may have got its CPU back


@dataclass(eq=False, slots=True)
class Asked:
    """A task under way, and what was known when it was asked."""

    task: Task
    id: str
    memory: KindMemory
    forecast: Forecast
    amount: float | None  # what the predictors were asked with
    decision: Decision
    seconds: dict[str, float] = field(default_factory=dict)  # of the sites that answered


class Learning:
    """Of all kinds. Called under the offloader's lock."""

    def __init__(self, runners: Mapping[str, Runner], allowance: Allowance) -> None:
        self.regret = RegretEstimate()
        self._runners = runners
        self._allowance = allowance
        self._expected: deque[tuple[Asked, Execution, float | None, int]] = deque(maxlen=TOGETHER)

    def learn(self, asked: Asked, executions: Sequence[Execution]) -> None:
        """What a task taught by the time it was answered; how it went as expected may wait for `catch_up`."""
        ended = [one for one in executions if not isinstance(one.failure, Overtaken)]
        work = asked.memory.work_told(ended)
        for one in ended:
            self._spend(asked, one)
        asked.memory.pass_by()
        if len(executions) == 1 and _as_expected(asked, ended[0]):
            if len(self._expected) == TOGETHER:
                self.catch_up()
            ahead = asked.memory.site(ended[0].site).told()
            self._expected.append((asked, ended[0].without_value(), work, ahead))
            return
        self.catch_up()
        self._learn(asked, ended, work)

    def learn_late(self, asked: Asked, execution: Execution) -> None:
        """A run that came second."""
        self.catch_up()
        self._spend(asked, execution)
        self._learn_one(asked, execution, asked.memory.work_of(execution))

    def between(self) -> None:
        """A task is under way, and nothing else to be done."""
        if len(self._expected) == TOGETHER:
            self.catch_up()

    def catch_up(self) -> None:
        """Nothing waits any more."""
        while self._expected:
            asked, execution, work, ahead = self._expected.popleft()
            self._learn(asked, [execution], work, ahead)

    def load(self, site: str) -> float:
        """Of the robot; of a server only where its times tell of that."""
        load = self._runners[ONBOARD].condition().load
        return load if site == ONBOARD or load > LOADED else 0.0

    def _spend(self, asked: Asked, execution: Execution) -> None:
        if self._allowance.capped:
            site = execution.site
            moved = 0 if site == ONBOARD else execution.bytes_out + execution.bytes_in
            self._allowance.spend(moved, asked.memory.site(site).joules(execution))

    def _learn(
        self, asked: Asked, executions: Sequence[Execution], work: float | None, ahead: int | None = None
    ) -> None:
        if work is not None:
            asked.memory.learn_size(asked.task.size, work)
        for execution in executions:
            self._learn_one(asked, execution, work, ahead)

    def _learn_one(
        self, asked: Asked, execution: Execution, work: float | None, ahead: int | None = None
    ) -> None:
        site, decision = execution.site, asked.decision
        memory = asked.memory.site(site)
        silent = not execution.ok and memory.conditional and self._held_up(site)
        amount = asked.amount if work is None else work
        outlook = asked.forecast.sites.get(site)
        if memory.conditional and outlook is not None:
            outlook = self._in_hindsight(outlook, execution)
        also_here = decision.second is not None and decision.second.site == site
        beside = site != ONBOARD and decision.site == ONBOARD and (decision.both or also_here)
        memory.learn(
            amount,
            execution,
            outlook,
            silent=silent,
            size=asked.task.size,
            work=work,
            beside=beside,
            ahead=ahead,
        )
        if execution.ok and isinstance(decision.second, Probe):
            asked.seconds[site] = execution.seconds
            if len(asked.seconds) == 2:
                self.regret.learn(asked.seconds[decision.site], asked.seconds[decision.second.site])

    def _held_up(self, site: str) -> bool:
        """Whether a server does not answer, or may not."""
        condition = self._runners[site].condition()
        return condition.silent or condition.wait_s > 0

    def _in_hindsight(self, outlook: Outlook, execution: Execution) -> Outlook:
        """With loads and capacities as they are now, where the time tells that they changed."""
        if not execution.ok or outlook.low_s is None or outlook.high_s is None:
            return outlook
        home = execution.site == ONBOARD
        later, sooner = execution.seconds > outlook.high_s, execution.seconds < outlook.low_s
        if not home and (later or sooner):
            outlook = self._as_the_server_says(execution.site, outlook, later=later)
        before = outlook.condition
        odd = later if before.load <= LOADED else sooner
        freed = home and sooner and execution.seconds < FREED * (outlook.predicted_s or 0.0)
        if not (odd or freed):
            return outlook
        self._runners[ONBOARD].hurry()
        load, capacity = before.load, before.capacity
        if odd:
            load = self.load(execution.site)
        if home:
            now = self._runners[ONBOARD].condition().capacity
            capacity = min(capacity, now) if later else max(capacity, now)
        if (load, capacity) == (before.load, before.capacity):
            return outlook
        return outlook._replace(condition=before._replace(load=load, capacity=capacity))

    def _as_the_server_says(self, site: str, outlook: Outlook, *, later: bool) -> Outlook:
        """In its answer to what was late, or early."""
        before, now = outlook.condition, self._runners[site].condition()
        worse, better = (max, min) if later else (min, max)
        load = worse(before.server_load, now.server_load)
        capacity = better(before.capacity, now.capacity)
        return outlook._replace(condition=before._replace(server_load=load, capacity=capacity))


def _as_expected(asked: Asked, execution: Execution) -> bool:
    """Whether a site that is known, and was in use, took no longer and no less than its interval said.

    Only predictors of measured features wait for such tasks: the paper's windows have each of them at once.
    """
    outlook = asked.forecast.sites.get(execution.site)
    return (
        execution.ok
        and outlook is not None
        and outlook.low_s is not None
        and outlook.high_s is not None
        and outlook.low_s <= execution.seconds <= outlook.high_s
        and outlook.full
        and outlook.failures == 0
        and outlook.age < TOGETHER
        and asked.memory.site(execution.site).conditional
    )
