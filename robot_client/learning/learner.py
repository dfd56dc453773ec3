"""What executions teach the memories, and when: those that have ended at once, the others when they end.

What is learned of one site is in `site`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from offboard.common.errors import Overtaken
from offboard.common.tasks import Size, Task
from offboard.robot_client.learning.kind import KindMemory
from offboard.robot_client.learning.regret import RegretEstimate
from offboard.robot_client.policies import Decision, Forecast, Probe
from offboard.robot_client.policies.allowance import Allowance
from offboard.robot_client.sites.runner import ONBOARD, Execution, Runner


@dataclass(eq=False, slots=True)
class PendingTask:
    """A task that is under way, and what was known when it was decided.

    `amount`: what the predictors were asked for. `seconds`: the times of the sites that have answered.
    """

    task: Task
    id: str
    memory: KindMemory
    forecast: Forecast
    amount: Size | None
    decision: Decision
    seconds: dict[str, float] = field(default_factory=dict)

    def predicted_s(self, site: str) -> float:
        """What the task should take there; 0 if that is unknown."""
        outlook = self.forecast.sites.get(site)
        return (outlook.predicted_s if outlook else None) or 0.0

    def task_for(self, site: str) -> Task:
        """The task as this site gets it."""
        outlook = self.forecast.sites.get(site)
        if outlook is None or outlook.packing is None or not outlook.packing.compress:
            return self.task
        return replace(self.task, compress=outlook.packing.compress)


class Learner:
    """Teaches the memories of all kinds. Called under the offloader's lock."""

    def __init__(self, runners: Mapping[str, Runner], allowance: Allowance) -> None:
        self.regret = RegretEstimate()
        self._runners = runners
        self._allowance = allowance

    def learn(self, pending: PendingTask, executions: Sequence[Execution]) -> None:
        """Learn what had ended when the task was answered."""
        ended = [one for one in executions if not isinstance(one.failure, Overtaken)]
        work = pending.memory.work_of_any(ended)
        pending.memory.count_task()
        if work is not None:
            pending.memory.learn_size(pending.task.size, work)
        for execution in ended:
            self._learn_one(pending, execution, work)

    def learn_late(self, pending: PendingTask, execution: Execution) -> None:
        """Learn a run that ended after another site had answered."""
        self._learn_one(pending, execution, pending.memory.work_of(execution))

    def _learn_one(self, pending: PendingTask, execution: Execution, work: float | None) -> None:
        self._spend(pending, execution)
        site, decision = execution.site, pending.decision
        memory = pending.memory.site(site)
        if site != ONBOARD:
            pending.memory.packing.learn(execution)
        second_here = decision.second is not None and decision.second.site == site
        memory.learn(
            pending.amount if work is None else work,
            execution,
            pending.forecast.sites.get(site),
            silent=not execution.ok and memory.measured and self._held_up(site),
            size=pending.task.size,
            work=work,
            beside=site != ONBOARD and decision.site == ONBOARD and (decision.both or second_here),
        )
        if execution.ok and isinstance(decision.second, Probe):
            pending.seconds[site] = execution.seconds
            if len(pending.seconds) == 2:
                self.regret.learn(pending.seconds[decision.site], pending.seconds[decision.second.site])

    def _held_up(self, site: str) -> bool:
        """Whether the site does not answer heartbeats, or may be about to."""
        condition = self._runners[site].condition()
        return condition.silent or condition.wait_s > 0

    def _spend(self, pending: PendingTask, execution: Execution) -> None:
        if self._allowance.capped:
            site = execution.site
            moved = 0 if site == ONBOARD else execution.bytes_out + execution.bytes_in
            self._allowance.spend(moved, pending.memory.site(site).joules(execution))
