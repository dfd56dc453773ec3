"""What executions teach the memories, and when: surprises at once, expected times a few tasks later.

With a tenth of a CPU, every computation between an answer and the next request takes ten times as long.
Therefore expected times are learnt while the next task is under way.
What is learnt of one site is in `site`.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

from offboard.common.errors import Overtaken
from offboard.common.tasks import Task
from offboard.robot_client.learning.conditions import Conditions
from offboard.robot_client.learning.kind import KindMemory
from offboard.robot_client.learning.regret import RegretEstimate
from offboard.robot_client.policies import Decision, Forecast, Probe
from offboard.robot_client.policies.allowance import Allowance
from offboard.robot_client.sites.runner import ONBOARD, Execution

TOGETHER = 4  # tasks with an expected time are learnt at once


@dataclass(eq=False, slots=True)
class PendingTask:
    """A task that is under way, and what was known when it was decided.

    `amount`: what the predictors were asked for. `seconds`: the times of the sites that have answered.
    """

    task: Task
    id: str
    memory: KindMemory
    forecast: Forecast
    amount: float | None
    decision: Decision
    seconds: dict[str, float] = field(default_factory=dict)


class Learner:
    """Teaches the memories of all kinds. Called under the offloader's lock."""

    def __init__(self, conditions: Conditions, allowance: Allowance) -> None:
        self.regret = RegretEstimate()
        self._conditions = conditions
        self._allowance = allowance
        self._expected: deque[tuple[PendingTask, Execution, float | None, int]] = deque(maxlen=TOGETHER)

    def learn(self, pending: PendingTask, executions: Sequence[Execution]) -> None:
        """Learn what had ended when the task was answered; an expected time may wait for `catch_up`."""
        ended = [one for one in executions if not isinstance(one.failure, Overtaken)]
        work = pending.memory.work_of_any(ended)
        for one in ended:
            self._spend(pending, one)
        pending.memory.count_task()
        if len(executions) == 1 and _as_expected(pending, ended[0]):
            if len(self._expected) == TOGETHER:
                self.catch_up()
            ahead = pending.memory.site(ended[0].site).count_run()
            self._expected.append((pending, ended[0].without_value(), work, ahead))
            return
        self.catch_up()
        self._learn(pending, ended, work)

    def learn_late(self, pending: PendingTask, execution: Execution) -> None:
        """Learn a run that ended after another site had answered."""
        self.catch_up()
        self._spend(pending, execution)
        self._learn_one(pending, execution, pending.memory.work_of(execution))

    def use_idle_time(self) -> None:
        """Learn the expected times if there are enough of them; called while a task is under way."""
        if len(self._expected) == TOGETHER:
            self.catch_up()

    def catch_up(self) -> None:
        """Learn all expected times that wait."""
        while self._expected:
            pending, execution, work, ahead = self._expected.popleft()
            self._learn(pending, [execution], work, ahead)

    def _spend(self, pending: PendingTask, execution: Execution) -> None:
        if self._allowance.capped:
            site = execution.site
            moved = 0 if site == ONBOARD else execution.bytes_out + execution.bytes_in
            self._allowance.spend(moved, pending.memory.site(site).joules(execution))

    def _learn(
        self,
        pending: PendingTask,
        executions: Sequence[Execution],
        work: float | None,
        ahead: int | None = None,
    ) -> None:
        if work is not None:
            pending.memory.learn_size(pending.task.size, work)
        for execution in executions:
            self._learn_one(pending, execution, work, ahead)

    def _learn_one(
        self, pending: PendingTask, execution: Execution, work: float | None, ahead: int | None = None
    ) -> None:
        site, decision = execution.site, pending.decision
        memory = pending.memory.site(site)
        silent = not execution.ok and memory.conditional and self._conditions.held_up(site)
        outlook = pending.forecast.sites.get(site)
        if memory.conditional and outlook is not None and not getattr(memory, "parts", False):
            outlook = self._conditions.in_hindsight(outlook, execution)
        second_here = decision.second is not None and decision.second.site == site
        memory.learn(
            pending.amount if work is None else work,
            execution,
            outlook,
            silent=silent,
            size=pending.task.size,
            work=work,
            beside=site != ONBOARD and decision.site == ONBOARD and (decision.both or second_here),
            ahead=ahead,
        )
        if execution.ok and isinstance(decision.second, Probe):
            pending.seconds[site] = execution.seconds
            if len(pending.seconds) == 2:
                self.regret.learn(pending.seconds[decision.site], pending.seconds[decision.second.site])


def _as_expected(pending: PendingTask, execution: Execution) -> bool:
    """Whether the time was inside the interval of a site that is well known and in use.

    Only predictors of measured features may wait for such times. The windows of the published rule must hold
    each time before the next task.
    """
    outlook = pending.forecast.sites.get(execution.site)
    return (
        execution.ok
        and outlook is not None
        and outlook.low_s is not None
        and outlook.high_s is not None
        and outlook.low_s <= execution.seconds <= outlook.high_s
        and outlook.full
        and outlook.failures == 0
        and outlook.age < TOGETHER
        and pending.memory.site(execution.site).conditional
        and not getattr(pending.memory.site(execution.site), "parts", False)
    )
