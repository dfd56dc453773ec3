"""The runs of a task, from the decision to what they teach: starts them, counts second runs, hears late ones.

What is decided is in `policies`; when each run of one task starts is in `execution/race.py`.
"""

import threading
from collections import deque
from collections.abc import Sequence
from functools import partial

from offboard.common.errors import Overtaken, TaskError
from offboard.robot_client.execution.choice import plan_of
from offboard.robot_client.execution.race import Plan, Race, result_of
from offboard.robot_client.learning.learner import Learner, PendingTask
from offboard.robot_client.learning.runs_in_flight import Flights
from offboard.robot_client.lifetime import Lifetime
from offboard.robot_client.policies import PINNED, Hedge
from offboard.robot_client.policies.allowance import Allowance
from offboard.robot_client.records.record import Late
from offboard.robot_client.sites.runner import ONBOARD, Execution
from offboard.robot_client.sites.waiting import Clock

LATE_MAX = 64  # executions that ended after their task was answered, kept for the next record


class TaskRuns:
    """Carries out decisions. `lock` is that of the offloader: under it everything is learnt and counted.

    `late`: the executions that ended after their task was answered; the next record takes them.
    """

    def __init__(
        self,
        clock: Clock,
        lock: threading.Lock,
        *,
        flights: Flights,
        allowance: Allowance,
        learner: Learner,
        life: Lifetime,
    ) -> None:
        self._clock = clock
        self._lock = lock
        self._flights = flights
        self._allowance = allowance
        self._learner = learner
        self._life = life
        self.late: deque[Late] = deque(maxlen=LATE_MAX)
        self._begun_onboard = 0

    def execute(self, pending: PendingTask) -> tuple[Execution, ...]:
        """Run the task on the sites of its decision."""
        race, plan = self.race(pending)
        if pending.deadline_s is not None:  # its caller may ask before the race has ended
            pending.so_far = partial(race.runs.so_far, self._clock)
        caller = pending.caller
        try:
            if caller is None:
                return race.run(plan)
            caller.withdraw.add(race.cancel)
            executions = race.run(plan, caller)
            pending.cancelled = caller.stop.done()
            return executions
        except BaseException:  # closed, or Ctrl-C: nobody waits for what still runs
            race.cancel()
            with self._lock:
                self._flights.end_all(pending.task.id, now_s=self._clock.now_s())
            raise
        finally:
            if caller is not None:
                caller.withdraw.discard(race.cancel)

    def race(self, pending: PendingTask) -> tuple[Race, Plan]:
        """The runs of the task, before the first one starts."""
        decision = pending.decision
        race = Race(
            pending.task,
            pending.runners,
            self._clock,
            pending.timeout_s,
            begun=partial(self._begun, pending),
            task_for=pending.task_for,
            allowed=partial(self._allowed, pending),
            late=partial(self._ended_late, pending),
        )
        hurried = pending.deadline_s is not None
        plan = plan_of(decision, pending.forecast, pending.call, hurried=hurried)
        plan.falls_back = pending.caller is None or pending.caller.falls_back
        latest = plan.latest
        if latest is not None and latest.after_s <= 0 and not self._allowed(pending, latest.site):
            plan.latest = None
        if plan.latest is not None:  # it counts from the beginning of the call
            left_s = plan.latest.after_s - (self._clock.now_s() - pending.started_s)
            plan.latest = Hedge(plan.latest.site, left_s)
        if decision.both and decision.policy != PINNED:  # not if the caller measures all sites
            with self._lock:
                for _ in plan.first[1:]:
                    self._allowance.duplicate()
        return race, plan

    def measure(self, pending: PendingTask, site: str) -> None:
        """Run a task that was answered on another site too, if a second run may start, and learn its time."""
        if not self._allowed(pending, site):
            return
        before = self._begun_onboard
        busy = self._flights.count(ONBOARD) > 0
        self._begun(pending, site)
        run = pending.runners[site].submit(pending.task_for(site), pending.timeout_s)
        self._clock.wait([run])
        bound = busy or self._begun_onboard != before
        self._ended_late(pending, site, result_of(site, run), bound=bound)

    def learn(self, pending: PendingTask, executions: Sequence[Execution]) -> None:
        """Learn the runs that have ended by now. Called under the lock."""
        for one in executions:
            if not isinstance(one.failure, Overtaken):
                self._flights.end(one.site, pending.task.id, now_s=self._clock.now_s())
        if not self._life.closed:  # a run that `close` gave up says nothing about its site
            self._learner.learn(pending, executions)

    def take_late(self) -> tuple[Late, ...]:
        """Empty `late`. Called under the lock."""
        late = tuple(self.late)
        self.late.clear()
        return late

    def _begun(self, pending: PendingTask, site: str) -> None:
        outlook = pending.forecast.sites.get(site)
        predicted_s = 0.0
        if outlook is not None and outlook.predicted_s is not None:
            predicted_s = max(0.0, outlook.predicted_s - outlook.condition.wait_s)
        with self._lock:
            self._flights.begin(
                site,
                pending.task.id,
                kind=pending.task.kind.name,
                predicted_s=predicted_s,
                now_s=self._clock.now_s(),
            )
            self._begun_onboard += site == ONBOARD

    def _allowed(self, pending: PendingTask, site: str) -> bool:
        """Whether a second run may start on this site; it is then counted. A fallback needs no permission."""
        with self._lock:
            allowed = self._allowance.take_duplicate()
        if not allowed:
            pending.refused = site
        return allowed

    def _ended_late(
        self, pending: PendingTask, site: str, execution: Execution, *, bound: bool | None = None
    ) -> None:
        """A run has ended after its task was answered; called in any thread."""
        with self._lock:
            self._flights.end(site, pending.task.id, now_s=self._clock.now_s())
            ran = execution.started or isinstance(execution.failure, TaskError)  # or its setup failed
            if ran and not self._life.closed:
                self._learner.learn_late(pending, execution, bound=bound)
            self.late.append(Late(pending.id, execution.without_value()))
