"""One task on the sites of its decision: when each site starts, and whose answer is used.

The sites are chosen in `policies`; what comes of the runs is learnt in `learning`.
"""

from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import CancelledError, Future
from dataclasses import dataclass, field
from operator import itemgetter
from typing import Any, TypeAlias

from offboard.common.errors import CloudError, Overtaken, SiteClosed, TaskError
from offboard.common.tasks import Kind, Task
from offboard.robot_client.execution.call_future import CallFuture
from offboard.robot_client.policies import Hedge, Probe
from offboard.robot_client.sites.onboard import OnboardAnswer
from offboard.robot_client.sites.runner import ONBOARD, Execution, Runner
from offboard.robot_client.sites.waiting import Answer, Clock

FIRST = "another site answered first"
ROUNDING_S = 1e-6  # a wait for less than this may end without the clock having moved

Wait: TypeAlias = tuple[Sequence[Future[Any]], float | None]  # for one to be done, in seconds
Steps: TypeAlias = Generator[Wait, None, tuple[Execution, ...]]


@dataclass(slots=True)
class Plan:
    """When the sites of one task start.

    `first`: the sites that start at once. `second`: a second run.
    `latest`: a run that starts then, allowed or not, if no answer has come; from the start of the race.
    `all`: wait for every run, not for the first answer.
    `keep`: runs that lose the race go on to their end, so that their whole time is learnt.
    `call`: a future that may name one more site while the task runs; that site then starts too.
    `lost_s`: what the quality that each site loses is worth. The first answer waits for a better one that is
    under way, at most for the difference.
    `falls_back`: whether onboard replaces runs that have all failed.
    """

    first: tuple[str, ...]
    second: Probe | Hedge | None = None
    latest: Hedge | None = None
    all: bool = False
    keep: bool = False
    call: "Future[str] | None" = None
    lost_s: Mapping[str, float] = field(default_factory=dict)
    falls_back: bool = True


class Runs(dict[str, tuple["Future[Execution]", float]]):
    """The runs of one task by site, in the order of their start: the future and the start time of each."""

    def result(self, site: str) -> Execution:
        """The execution of a run that is done."""
        execution = result_of(site, self[site][0])
        execution.after_s = self._after_s(site)
        return execution

    def unended(self, site: str, why: str, now_s: float) -> Execution:
        """The execution of a run that is under way."""
        run, began_s = self[site]
        setup_s = run.setup_s() if isinstance(run, OnboardAnswer) else 0.0
        seconds = now_s - began_s - setup_s
        return Execution(site, seconds, failure=Overtaken(why), censored=True, after_s=self._after_s(site))

    def so_far(self, clock: Clock) -> tuple[Execution, ...]:
        """All executions at this moment. Another thread may run the race meanwhile."""
        return tuple(
            self.result(site) if run.done() else self.unended(site, "still under way", clock.now_s())
            for site, (run, _) in list(self.items())
        )

    def _after_s(self, site: str) -> float:
        return self[site][1] - next(iter(self.values()))[1]


class Race:
    """Runs one task.

    `begun`: called with every site that starts.
    `allowed`: asked before a second run starts on a site. A fallback, which replaces failed runs, always may.
    `late`: called in any thread when a run ends after the task was answered.
    `task_for`: returns the task as a site gets it (None: each site gets the same).
    """

    def __init__(
        self,
        task: Task,
        runners: Mapping[str, Runner],
        clock: Clock,
        timeout_s: float,
        *,
        begun: Callable[[str], None],
        allowed: Callable[[str], bool],
        late: Callable[[str, Execution], None],
        task_for: Callable[[str], Task] | None = None,
    ) -> None:
        self._task = task
        self._runners = runners
        self._clock = clock
        self._timeout_s = timeout_s
        self._begun = begun
        self._allowed = allowed
        self._late = late
        self._task_for = task_for
        self.runs = Runs()

    def run(self, plan: Plan, caller: "CallFuture[Any] | None" = None) -> tuple[Execution, ...]:
        """All executions in the order of their start; runs that are still under way count as overtaken.

        `caller`: ends the race if it is cancelled.
        """
        steps = self.steps(plan)
        while True:
            try:
                pending, timeout_s = next(steps)
            except StopIteration as ended:
                executions: tuple[Execution, ...] = ended.value
                return executions
            if caller is None:
                self._clock.wait(pending, timeout_s)
                continue
            if not caller.stop.done():
                # A cancel ends a remote run at once, so its caller may read the socket alone.
                remote = len(pending) == 1 and isinstance(pending[0], Answer)
                self._clock.wait(pending if remote else [*pending, caller.stop], timeout_s)
            if caller.stop.done():
                return self._withdraw()

    def steps(self, plan: Plan) -> Steps:
        """The same, for a caller that waits itself: yields each wait, and goes on when it is over."""
        for site in plan.first:
            self._start(site)
        if plan.all:
            yield from self._wait_for_all()
        else:
            answered = yield from self._wait_for_answer(plan)
            if answered is not None and plan.lost_s.get(answered):
                yield from self._wait_for_better(plan.lost_s, answered)
        if len(self.runs) == 1:
            executions = {site: result_of(site, run) for site, (run, _) in self.runs.items() if run.done()}
        else:
            executions = {site: self.runs.result(site) for site, (run, _) in self.runs.items() if run.done()}
        if (
            plan.falls_back
            and ONBOARD not in self.runs
            and all(_may_fall_back(one, self._task.kind) for one in executions.values())
        ):
            self._start(ONBOARD)
            yield from self._wait_for_all()
            executions[ONBOARD] = self.runs.result(ONBOARD)
        for site in self.runs:
            if site not in executions:
                keep = plan.keep or isinstance(plan.second, Probe)
                executions[site] = self._leave(site, FIRST, keep=keep)
        return tuple(executions[site] for site in self.runs)

    def cancel(self) -> None:
        """Nobody wants the answer any more."""
        for site, (run, _) in list(self.runs.items()):  # any thread may call this
            if not run.done():
                self._runners[site].cancel(self._task)

    def _withdraw(self) -> tuple[Execution, ...]:
        """Leave all runs: the caller has cancelled the call."""
        ended = {site: self.runs.result(site) for site, (run, _) in self.runs.items() if run.done()}
        return tuple(
            self._leave(site, "the call was cancelled", keep=False)
            if site not in ended or isinstance(ended[site].failure, Overtaken)
            else ended[site]
            for site in self.runs
        )

    def _start(self, site: str) -> None:
        self._begun(site)
        task = self._task if self._task_for is None else self._task_for(site)
        began_s = self._clock.now_s()
        self.runs[site] = self._runners[site].submit(task, self._timeout_s), began_s

    def _wait_for_answer(self, plan: Plan) -> Generator[Wait, None, str | None]:
        """Start the later runs when they are due; the site of the first answer, None if all runs failed."""
        call, later = plan.call, _later(plan)
        _, began_s = self.runs[plan.first[0]]
        elapsed_s = 0.0
        while later and later[-1][0] <= 0:
            self._start_later(later.pop()[1], plan)
        while True:
            pending: list[Future[Any]] = []
            for site, (run, _) in self.runs.items():
                if not run.done():
                    pending.append(run)
                elif _is_answer(result_of(site, run), plan):
                    return site
            if not pending:
                return None
            if later and later[-1][0] <= elapsed_s + ROUNDING_S:
                self._start_later(later.pop()[1], plan)
            elif call is not None and call.done():
                self._answer_call(call.result())
                call = None
            else:
                wait_s = later[-1][0] - elapsed_s if later else None
                yield pending if call is None else [*pending, call], wait_s
                if later:
                    elapsed_s = self._clock.now_s() - began_s

    def _start_later(self, later: Probe | Hedge, plan: Plan) -> None:
        late = [site for site, (run, _) in self.runs.items() if not run.done()]
        if later.site in self.runs:
            return
        if later is plan.latest or self._allowed(later.site):
            self._start(later.site)
        if isinstance(later, Hedge):
            for site in late:  # after the start: the robot itself may be late because its CPU is busy
                self._runners[site].hurry()

    def _wait_for_better(self, lost_s: Mapping[str, float], answered: str) -> Generator[Wait, None, None]:
        """Wait on for a better answer, at most as long as it is worth."""
        better = [
            (run, lost_s[answered] - lost_s[site])
            for site, (run, _) in self.runs.items()
            if not run.done() and lost_s[site] < lost_s[answered]
        ]
        if better:
            yield [run for run, _ in better], max(worth_s for _, worth_s in better)

    def _answer_call(self, site: str) -> None:
        if site not in self.runs and site in self._runners and self._allowed(site):
            self._start(site)

    def _wait_for_all(self) -> Generator[Wait, None, None]:
        while pending := [run for run, _ in self.runs.values() if not run.done()]:
            yield pending, None

    def _leave(self, site: str, why: str, *, keep: bool) -> Execution:
        """Leave a run that is under way; it is cancelled, unless its whole time is wanted (`keep`)."""
        self.runs[site][0].add_done_callback(lambda _: self._late(site, self.runs.result(site)))
        if not keep:
            self._runners[site].cancel(self._task)
        return self.runs.unended(site, why, self._clock.now_s())


def _later(plan: Plan) -> list[tuple[float, Probe | Hedge]]:
    """The later runs, with the seconds until they are due; the next one comes last."""
    later: list[tuple[float, Probe | Hedge]] = []
    if plan.latest is not None:
        later.append((plan.latest.after_s, plan.latest))
    if plan.second is not None:
        later.append((plan.second.after_s if isinstance(plan.second, Hedge) else 0.0, plan.second))
        later.sort(key=itemgetter(0), reverse=True)
    return later


def answer_of(executions: tuple[Execution, ...], kind: Kind) -> Execution:
    """The good answer of the highest quality, and of several the fastest; or else a failure.

    The failure of the task itself comes first, and then the last failure of a site.
    """
    good = [execution for execution in executions if execution.ok]
    if len(good) == 1:
        return good[0]
    if good:
        return min(good, key=lambda one: (-kind.at(one.site).quality, one.seconds))
    own = [execution for execution in executions if isinstance(execution.failure, TaskError)]
    return (own or list(executions))[-1]


def result_of(site: str, future: "Future[Execution]") -> Execution:
    """The result of a run. A runner ends every run within its budget; `close` cancels the future instead."""
    try:
        return future.result()
    except CancelledError:
        return Execution(site, 0.0, failure=SiteClosed("closed while the task was in flight"), started=False)


def _is_answer(execution: Execution, plan: Plan) -> bool:
    """Whether the race is over: if the task itself fails, it fails on every site; its setup may not.

    In a warm-up nobody knows that, and the other site runs it anyway.
    """
    failed = not plan.keep and isinstance(execution.failure, TaskError) and execution.started
    return execution.ok or failed


def _may_fall_back(execution: Execution, kind: Kind) -> bool:
    return isinstance(execution.failure, CloudError) and (kind.duplicate or not execution.started)
