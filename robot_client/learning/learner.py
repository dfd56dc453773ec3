"""What executions teach the memories, and when: those that have ended at once, the others when they end.

What is learned of one site is in `site`.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import Any

from offboard.common.errors import Overtaken
from offboard.common.tasks import Size, Task
from offboard.robot_client.learning.kind import KindMemory
from offboard.robot_client.learning.regret import RegretEstimate
from offboard.robot_client.learning.savings import Savings, SavingsEstimate
from offboard.robot_client.policies import ALONE, Decision, Forecast, Probe
from offboard.robot_client.policies.allowance import Allowance
from offboard.robot_client.policies.objectives import Weighing
from offboard.robot_client.sites.runner import ONBOARD, Execution, Runner


@dataclass(eq=False, slots=True)
class PendingTask:
    """A task that is under way, and what was known when it was decided.

    `runners`: those of the sites that were present then. `absent`: why some are not in the forecast.
    `amount`: what the predictors were asked for.
    `started_s`: by the clock of the offloader. `call`: may name one more site while the task runs.
    `answered`: gets answer, record and when it came, for a caller that waits until a deadline.
    `caller`: the `CallFuture` of its call, if it has one.
    `so_far`: its runs at the moment, once they have begun. `refused`: as in the record.
    `work`: what a result told. `ended`: the runs that a probe is compared by.
    """

    task: Task
    runners: Mapping[str, Runner]
    i: int
    id: str
    memory: KindMemory
    forecast: Forecast
    amount: Size | None
    decision: Decision
    timeout_s: float
    started_s: float
    started_at: datetime
    absent: Mapping[str, str]
    call: "Future[str] | None" = None
    deadline_s: float | None = None
    answered: "Future[tuple[Execution, Any, float]] | None" = None
    caller: Any = None
    so_far: Callable[[], tuple[Execution, ...]] | None = None
    refused: str | None = None
    cancelled: bool = False
    work: float | None = None
    ended: dict[str, Execution] = field(default_factory=dict)

    def task_for(self, site: str) -> Task:
        """The task as this site gets it."""
        outlook = self.forecast.sites.get(site)
        if outlook is None or outlook.packing is None or not outlook.packing.compress:
            return self.task
        return replace(self.task, compress=outlook.packing.compress)


class Learner:
    """Teaches the memories of all kinds. Called under the offloader's lock."""

    def __init__(self, allowance: Allowance, weighing: Weighing) -> None:
        self.regret = RegretEstimate()
        self._savings: dict[str, SavingsEstimate] = {}  # by kind; empty unless the policy only observes
        self._allowance = allowance
        self._weighing = weighing

    def learn(self, pending: PendingTask, executions: Sequence[Execution]) -> None:
        """Learn what had ended when the task was answered."""
        ended = [one for one in executions if not isinstance(one.failure, Overtaken)]
        work = pending.work = pending.memory.work_of_any(ended)
        pending.memory.count_task()
        if work is not None:
            pending.memory.learn_size(pending.task.size, work)
        for execution in ended:
            self._learn_one(pending, execution, work)

    def learn_late(self, pending: PendingTask, execution: Execution, *, bound: bool | None = None) -> None:
        """Learn a run that ended after another site had answered.

        `bound`: the robot ran tasks itself meanwhile (None: the decision says it).
        """
        self._learn_one(pending, execution, pending.memory.work_of(execution), bound=bound)

    def _learn_one(
        self, pending: PendingTask, execution: Execution, work: float | None, *, bound: bool | None = None
    ) -> None:
        self._spend(execution)
        site, decision = execution.site, pending.decision
        memory = pending.memory.site(site)
        if bound is None:
            second_here = decision.second is not None and decision.second.site == site
            bound = site != ONBOARD and decision.site == ONBOARD and (decision.both or second_here)
        if site != ONBOARD:
            pending.memory.packing.learn(execution)
        execution.held_up = not execution.ok and memory.measured and _held_up(pending.runners[site])
        memory.learn(
            pending.amount if work is None else work,
            execution,
            pending.forecast.sites.get(site),
            silent=execution.held_up,
            size=pending.task.size,
            work=work,
            bound=bound,
        )
        if isinstance(decision.second, Probe) and site in (decision.site, decision.second.site):
            pending.ended[site] = execution
            if len(pending.ended) == 2:
                self._compare(pending, pending.ended[decision.site], pending.ended[decision.second.site])
        if site == decision.site and (
            decision.advised is not None or (self._savings and decision.policy == ALONE)
        ):
            self._note_saving(pending, execution)

    def _compare(self, pending: PendingTask, chosen: Execution, probed: Execution) -> None:
        """Both runs of a probe have ended."""
        if chosen.ok and probed.ok:
            sites = pending.forecast.sites
            lost_s = [sites[one.site].quality.lost_s for one in (chosen, probed)]
            self.regret.learn(chosen.seconds + lost_s[0], probed.seconds + lost_s[1])
        expected_s = _advised_s(pending)
        if chosen.ok and expected_s is not None and pending.decision.advised == probed.site:
            # Without an answer of the site, the task would have run onboard after this time.
            took_s = probed.seconds if probed.ok else probed.seconds + chosen.seconds
            self._savings_of(pending).probe(expected_s - took_s)

    def _note_saving(self, pending: PendingTask, execution: Execution) -> None:
        """A task that is only observed was answered."""
        decision, expected_s = pending.decision, _advised_s(pending)
        if not execution.ok:
            return
        if decision.advised in (execution.site, None):  # None: no other site was there
            self._savings_of(pending).stay()
        elif expected_s is not None:
            sites = pending.forecast.sites
            gained_s = sites[execution.site].quality.lost_s - sites[decision.advised].quality.lost_s
            self._savings_of(pending).move(execution.seconds - expected_s, gained_s)

    def _savings_of(self, pending: PendingTask) -> SavingsEstimate:
        return self._savings.setdefault(pending.task.kind.name, SavingsEstimate())

    def savings(self) -> dict[str, Savings | None]:
        """The present estimate for each kind."""
        return {kind: one.estimate() for kind, one in self._savings.items()}

    def _spend(self, execution: Execution) -> None:
        if self._allowance.capped:
            site = execution.site
            moved = 0 if site == ONBOARD else execution.bytes_out + execution.bytes_in
            self._allowance.spend(moved, self._weighing.joules(execution))


def _held_up(runner: Runner) -> bool:
    """Whether the site does not answer heartbeats, or may be about to."""
    condition = runner.condition()
    return condition.silent or condition.wait_s > 0


def _advised_s(pending: PendingTask) -> float | None:
    """The predicted time on the site where the policy would have sent a task that is only observed."""
    advised = pending.decision.advised
    return None if advised is None else pending.forecast.sites[advised].predicted_s
