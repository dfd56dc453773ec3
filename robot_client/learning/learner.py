"""What executions teach the memories, and when: surprises at once, an expected time during the next task.

With a tenth of a CPU, every computation between an answer and the next request takes ten times as long. The
time that was expected would hardly change the next decision. What is learned of one site is in `site`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

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


class Learner:
    """Teaches the memories of all kinds. Called under the offloader's lock."""

    def __init__(self, runners: Mapping[str, Runner], allowance: Allowance) -> None:
        self.regret = RegretEstimate()
        self._runners = runners
        self._allowance = allowance
        self._expected: tuple[PendingTask, Execution, float | None, int] | None = None

    def learn(self, pending: PendingTask, executions: Sequence[Execution]) -> None:
        """Learn what had ended when the task was answered; an expected time waits for `catch_up`."""
        self.catch_up()
        ended = [one for one in executions if not isinstance(one.failure, Overtaken)]
        work = pending.memory.work_of_any(ended)
        pending.memory.count_task()
        for execution in ended:
            self._spend(pending, execution)
        if len(executions) == 1 and _as_expected(pending, ended[0]):
            ahead = pending.memory.site(ended[0].site).count_run()
            self._expected = pending, ended[0].without_value(), work, ahead
        else:
            self._learn(pending, ended, work)

    def learn_late(self, pending: PendingTask, execution: Execution) -> None:
        """Learn a run that ended after another site had answered."""
        self.catch_up()
        self._spend(pending, execution)
        self._learn_one(pending, execution, pending.memory.work_of(execution))

    def catch_up(self) -> None:
        """Learn the expected time that waits, if one does."""
        if self._expected is not None:
            pending, execution, work, ahead = self._expected
            self._expected = None
            self._learn(pending, [execution], work, ahead)

    def _learn(
        self,
        pending: PendingTask,
        ended: Sequence[Execution],
        work: float | None,
        ahead: int | None = None,
    ) -> None:
        if work is not None:
            pending.memory.learn_size(pending.task.size, work)
        for execution in ended:
            self._learn_one(pending, execution, work, ahead)

    def _learn_one(
        self, pending: PendingTask, execution: Execution, work: float | None, ahead: int | None = None
    ) -> None:
        site, decision = execution.site, pending.decision
        memory = pending.memory.site(site)
        second_here = decision.second is not None and decision.second.site == site
        memory.learn(
            pending.amount if work is None else work,
            execution,
            pending.forecast.sites.get(site),
            silent=not execution.ok and memory.measured and self._held_up(site),
            size=pending.task.size,
            work=work,
            beside=site != ONBOARD and decision.site == ONBOARD and (decision.both or second_here),
            ahead=ahead,
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


def _as_expected(pending: PendingTask, execution: Execution) -> bool:
    """Whether the time of a known site was inside its interval.

    The windows of the published rule hold each time before the next task.
    """
    outlook = pending.forecast.sites.get(execution.site)
    return (
        execution.ok
        and outlook is not None
        and outlook.full
        and outlook.low_s is not None
        and outlook.high_s is not None
        and outlook.low_s <= execution.seconds <= outlook.high_s
        and pending.memory.site(execution.site).measured
    )
