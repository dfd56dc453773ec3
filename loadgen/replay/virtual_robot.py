"""A robot in virtual time: the `Offloader` of the robot runs recorded tasks on recorded sites.

Either the policy decides (`play`), or the run is followed and the policy is only asked (`follow`). Its
decisions can then be compared with those of the run.
"""

import contextlib
import functools
import itertools
import math
import operator
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from offboard.common.errors import OffloadError
from offboard.common.tasks import Size, task
from offboard.loadgen.replay.recorded_site import RecordedSite
from offboard.loadgen.replay.recorded_tasks import RecordedTask
from offboard.loadgen.simulation.model.stepped_offloader import SteppedOffloader, Walk, Walker
from offboard.robot_client.execution import batch
from offboard.robot_client.learning.memories import Memories
from offboard.robot_client.policies import ALONE, PINNED, Decision, Forecast, Hedge, Policy, observe
from offboard.robot_client.policies.allowance import Allowance
from offboard.robot_client.policies.decision import pairs
from offboard.robot_client.records.record import Record
from offboard.robot_client.sites.runner import CLOUD, ONBOARD
from offboard.testing.virtual_clock import VirtualClock

NOT_BY_A_RULE = (PINNED, ALONE, batch.NAME, observe.NAME)  # who else decides where a task runs
DELAY_TOLERANCE = 0.05  # of the delay of a hedge: with less between two delays, they are the same decision
ON_BOTH = Decision(ONBOARD, "all sites learn", PINNED, both=True, waits=True)


class Played(NamedTuple):
    """What became of a task: whether the cloud answered, whether two sites ran it, how long it took."""

    to_cloud: bool
    twice: bool
    seconds: float


class VirtualRobot:
    """Runs tasks one after the other; `sites` are its sites, in the order in which it knows them."""

    def __init__(
        self, policy: Policy, memories: Memories, *, tells_work: bool, sites: Sequence[str] = (ONBOARD, CLOUD)
    ) -> None:
        self._tells_work = tells_work
        self._clock = VirtualClock()
        self._zero_s: float | None = None  # when the first task began, on the clock of the run
        self._allowance = Allowance()
        self._sites = [RecordedSite(site, self._clock) for site in sites]
        self._chooser = _Chooser(policy)
        self._records: deque[Record] = deque(maxlen=1)
        self._offload = SteppedOffloader(
            self._sites,
            policy=self._chooser,
            memories=memories,
            allowance=self._allowance,
            observers=[self._records.append],
            clock=self._clock,
        )

    def play(self, tasks: Sequence[RecordedTask], *, warm_up: int, all_learn: bool) -> Iterator[Played]:
        """Let the policy decide every task after the first `warm_up`, which run on all sites.

        A task begins when the one before is answered. With `all_learn`, every site learns every task.
        """
        for number, recorded in enumerate(tasks):
            scored = number >= warm_up
            self._run(number, recorded, instead=ON_BOTH if all_learn or not scored else None, ask=scored)
            record = self._records.pop()
            if scored and all_learn:
                yield self._as_decided(self._chooser.decided, recorded)
            elif scored:
                runs = record.executions
                waited_s = runs[0].seconds if len(runs) == 1 else record.waited_s  # without rounding
                yield Played(record.used == CLOUD, len(runs) > 1, waited_s)

    def follow(self, tasks: Sequence[RecordedTask]) -> list[Decision | None]:
        """What the policy would have decided for each task after all that the run had learnt before.

        None: in the run no rule decided. Each task begins when it did in the run, and runs as it did there.
        """
        decided: list[Decision | None] = [None] * len(tasks)
        under_way: dict[int, RecordedTask] = {}

        def run(number: int, decision: Decision) -> Walk:
            one = tasks[number]
            self._begin(number, one, instead=decision, ask=decision.policy not in NOT_BY_A_RULE)
            yield from self._offload.steps(self._function(one), one.size, number, timeout_s=one.timeout_s)
            del under_way[number]

        for number in sorted(range(len(tasks)), key=lambda number: tasks[number].i):
            self._wait_for(tasks[number], under_way)
            under_way[number] = tasks[number]
            Walker(self._clock, run(number, _carried_out(tasks[number]))).begin()
            decided[number] = self._chooser.decided
        while under_way:
            self._clock.step(math.inf)
        return decided

    def _wait_for(self, begins: RecordedTask, under_way: Mapping[int, RecordedTask]) -> None:
        """Let the time pass until this task begins, and until all have their answer that had it by then."""
        began_s = begins.started_s
        if began_s is not None:
            self._zero_s = began_s if self._zero_s is None else self._zero_s
            self._clock.pass_by(max(0.0, began_s - self._zero_s - self._clock.now_s()))
        while any(began_s is None or one.answered_s <= began_s for one in under_way.values()):
            self._clock.step(math.inf)

    def _run(self, number: int, recorded: RecordedTask, *, instead: Decision | None, ask: bool) -> None:
        self._begin(number, recorded, instead=instead, ask=ask)
        with contextlib.suppress(OffloadError):  # as in the run, no site may have answered
            function = self._function(recorded)
            self._offload(function, recorded.size, number, timeout_s=recorded.timeout_s)

    def _function(self, recorded: RecordedTask) -> Callable[..., Any]:
        numbers = len(recorded.size) if isinstance(recorded.size, tuple) else 1
        return _looked_up(numbers, tells_work=self._tells_work)

    def _begin(self, number: int, recorded: RecordedTask, *, instead: Decision | None, ask: bool) -> None:
        self._chooser.begin(instead=instead, ask=ask)
        self._offload.deadline_s = recorded.deadline_s
        for site in self._sites:
            site.begin(number, recorded)

    def _as_decided(self, decision: Decision | None, recorded: RecordedTask) -> Played:
        """What would have become of a task that ran on both sites only so that both learn."""
        assert decision is not None, "the policy is always asked"
        site, second = decision.site, decision.second
        taken_s = {one: recorded.runs[one].seconds for one in (ONBOARD, CLOUD)}
        begins_s = {ONBOARD: 0.0, CLOUD: 0.0} if decision.both else {site: 0.0}
        if second is not None:
            after_s = second.after_s if isinstance(second, Hedge) else 0.0
            if after_s < taken_s[site] and self._allowance.duplicates >= 1:
                begins_s[second.site] = after_s
        if len(begins_s) > 1:
            self._allowance.duplicate()
        if decision.latest is not None and decision.latest.after_s < min(
            begins_s.get(ONBOARD, math.inf), taken_s[site]
        ):
            begins_s[ONBOARD] = decision.latest.after_s
        ends_s = {one: began_s + taken_s[one] for one, began_s in begins_s.items()}
        first = min(ends_s, key=ends_s.__getitem__)
        return Played(first == CLOUD, len(begins_s) > 1, ends_s[first])


def _carried_out(recorded: RecordedTask) -> Decision:
    """The decision of the run, without a second run that was then not due or not allowed."""
    decision = recorded.decision
    assert decision is not None, "a run is followed that decided its tasks"
    if decision.second is not None and decision.second.site not in recorded.runs:
        return decision._replace(second=None)
    return decision


class _Chooser:
    """Asks a policy, and carries out its decision or another one `instead`."""

    def __init__(self, policy: Policy) -> None:
        self._policy = policy
        self.pairs = pairs(policy)
        self.begin(instead=ON_BOTH, ask=False)

    def begin(self, *, instead: Decision | None, ask: bool) -> None:
        """The next task may be decided `instead` of the policy, which is then asked only with `ask`."""
        self._instead, self._ask = instead, ask
        self.decided: Decision | None = None

    def decide(self, forecast: Forecast) -> Decision:
        if self._ask or self._instead is None:
            self.decided = self._policy.decide(forecast)
        decision = self._instead or self.decided
        assert decision is not None
        return decision


def compare(
    tasks: Sequence[RecordedTask], make: Callable[[Sequence[str]], VirtualRobot]
) -> list[tuple[RecordedTask, Decision]]:
    """Each task that a rule decided in the run, with the decision of the robot that `make` makes for sites.

    The robot follows the run, so that before each task it has learnt what the run had learnt.
    """
    found = []
    # A robot that is started again knows nothing.
    for _, group in itertools.groupby(tasks, operator.attrgetter("process")):
        process = list(group)
        sites = tuple(dict.fromkeys(site for one in process for site in one.sites))
        for recorded, decision in zip(process, make(sites).follow(process), strict=True):
            if decision is not None:
                found.append((recorded, decision))
    return found


def same_percent(compared: Sequence[tuple[RecordedTask, Decision]]) -> float | None:
    """The share of decisions that are those of the run; None if there are none."""
    if not compared:
        return None
    return 100 * sum(same(one.decision, decision) for one, decision in compared) / len(compared)


def same(run: Decision | None, replayed: Decision) -> bool:
    """Whether both decisions start the same sites, at the same time but for DELAY_TOLERANCE."""
    if run is None or (run.site, run.both, run.spared) != (replayed.site, replayed.both, replayed.spared):
        return False
    one, other = run.second, replayed.second
    if isinstance(one, Hedge) and isinstance(other, Hedge):
        close = math.isclose(one.after_s, other.after_s, rel_tol=DELAY_TOLERANCE)
        return close and one.site == other.site
    return one == other


@functools.cache
def _looked_up(numbers: int, *, tells_work: bool) -> Callable[..., Any]:
    """The task of all recorded tasks whose sizes have this many numbers; its function is never run."""
    name = f"replayed_{numbers}{'_with_work' if tells_work else ''}"

    @task(name, size=lambda size, number: size, work=_work if tells_work else None)  # noqa: ARG005
    def looked_up(size: Size, number: int) -> float:  # noqa: ARG001
        raise AssertionError("a replayed task is looked up, not run")

    return looked_up


def _work(told: float | None) -> float:
    """NaN: the result of this task did not tell its work."""
    return math.nan if told is None else told
