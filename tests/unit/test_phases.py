"""Faults in every phase of a task: each task is answered once, and each site learns its own times only.

Time is virtual. Each case runs three tasks of different sizes: a plain one, the one with the fault, and a
plain one while runs of the second task may still be under way.
"""

from collections.abc import Callable
from random import Random
from typing import NamedTuple

import pytest

from offboard.common.errors import CloudBroken, CloudBusy, CloudTimeout, OffloadError, TaskFailed
from offboard.common.tasks import task
from offboard.robot_client import policies
from offboard.robot_client.learning.memories import Memories
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.policies import Decision, Forecast, Hedge, Policy, Probe
from offboard.robot_client.policies.allowance import DUPLICATES_MAX, Allowance
from offboard.robot_client.predictors.least_squares import LeastSquares
from offboard.robot_client.records.record import Record
from offboard.robot_client.settings import Settings
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, Condition
from tests.virtual import VirtualClock, VirtualRunner

EDGE = "edge"
PLAIN_S = {ONBOARD: 0.01, CLOUD: 0.02}  # time of a task without a fault
TIMEOUT_S = 2.0
HEDGE_S = 0.4

WARM_UP = Decision(ONBOARD, "warm-up", "scripted", both=True)
MEASURED = Decision(ONBOARD, "warm-up that waits", "scripted", both=True, waits=True)
PROBE = Decision(ONBOARD, "probe", "scripted", second=Probe(CLOUD))
PROBE_BACK = Decision(CLOUD, "probe", "scripted", second=Probe(ONBOARD))
HEDGE = Decision(CLOUD, "hedge", "scripted", second=Hedge(ONBOARD, HEDGE_S))
HEDGE_AWAY = Decision(ONBOARD, "hedge", "scripted", second=Hedge(CLOUD, HEDGE_S))

BROKEN, BUSY, LATE = CloudBroken("gone"), CloudBusy("full"), CloudTimeout("late")
FAILED = TaskFailed("ValueError: no")
OK = None
NEVER = (None, None)  # the server does not answer, and is given up after the timeout


@task("phase_echo", size=lambda number: number)
def phase_echo(number: int) -> int:
    return 100 * number


class Scripted:
    """Decides what the test has set as `next`."""

    def __init__(self) -> None:
        self.next = Decision(ONBOARD, "plain", "scripted")

    def decide(self, forecast: Forecast) -> Decision:  # noqa: ARG002
        return self.next


class Scene:
    """An offloader in virtual time, with access to the window of each site."""

    def __init__(self, policy: Policy | None = None) -> None:
        self.clock = VirtualClock()
        self.sites = {site: VirtualRunner(site, self.clock, PLAIN_S[site]) for site in (ONBOARD, CLOUD)}
        self.policy = Scripted()
        self.allowance = Allowance(1.0, first=0.0)
        self.records: list[Record] = []
        self._made: list[LeastSquares] = []
        self.offload = Offloader(
            list(self.sites.values()),
            policy=policy or self.policy,
            memories=Memories(self._remember),
            allowance=self.allowance,
            timeout_s=TIMEOUT_S,
            observers=[self.records.append],
            clock=self.clock,
        )

    def _remember(self) -> LeastSquares:
        self._made.append(LeastSquares(50))
        return self._made[-1]

    def ask(self, number: int, decision: Decision) -> int | str:
        """The answer, or the name of the exception."""
        self.policy.next = decision
        try:
            answer: int = self.offload(phase_echo, number)
        except OffloadError as error:
            return type(error).__name__
        return answer

    def learnt(self, site: str) -> list[tuple[float, float]]:
        """Size and seconds of each observation; the windows are made in the order of the runners."""
        return [(size, round(seconds, 6)) for size, seconds in self._made[[*self.sites].index(site)].window]

    def in_flight(self) -> int:
        return sum(self.offload._flights.count(site) for site in self.sites)


Run = tuple[float | None, OffloadError | None]


class Case(NamedTuple):
    """What the sites do with task 2, and what must be recorded and learnt.

    `onboard`, `cloud`: how long the site takes, and its failure.
    `runs`: the executions in the order of their start, with their failures.
    `onboard_s`, `cloud_s`: the time that the site learns (None: it learns nothing).
    """

    name: str
    decision: Decision
    onboard: Run
    cloud: Run
    runs: str
    onboard_s: float | None
    cloud_s: float | None
    duplicates: int = 1
    answer: int | str = 200


def lost(fault: OffloadError) -> list[Case]:
    """The cases of a cloud that is broken, busy or late; they differ only in the name of the failure."""
    name = type(fault).__name__
    onboard_first, cloud_first = f"onboard, cloud {name}", f"cloud {name}, onboard"
    left = "onboard, cloud Overtaken"
    return [
        Case(f"warm-up {name}", WARM_UP, (0.3, OK), (0.2, fault), onboard_first, 0.3, 0.2),
        Case(f"probe {name}", PROBE, (0.3, OK), (0.2, fault), onboard_first, 0.3, 0.2),
        Case(f"probe {name} after the answer", PROBE, (0.3, OK), (0.9, fault), left, 0.3, 0.9),
        Case(f"probe back {name}", PROBE_BACK, (0.3, OK), (0.2, fault), cloud_first, 0.3, 0.2),
        Case(f"hedge {name} before the second", HEDGE, (0.3, OK), (0.2, fault), cloud_first, 0.3, 0.2, 0),
        Case(f"hedge {name} while both run", HEDGE, (0.3, OK), (0.6, fault), cloud_first, 0.3, 0.6),
        Case(f"hedge away {name}", HEDGE_AWAY, (0.6, OK), (0.1, fault), onboard_first, 0.6, 0.1),
    ]


OWN = "TaskFailed"  # a failure of the task itself is raised, from the site that reports it first
CASES = [
    *(case for fault in (BROKEN, BUSY, LATE) for case in lost(fault)),
    Case("warm-up", WARM_UP, (0.3, OK), (0.2, OK), "onboard Overtaken, cloud", 0.3, 0.2),
    Case("warm-up that waits", MEASURED, (0.3, OK), (0.2, OK), "onboard, cloud", 0.3, 0.2),
    Case("warm-up, silent", WARM_UP, (0.3, OK), NEVER, "onboard, cloud Overtaken", 0.3, 2.0),
    Case("warm-up that waits, silent", MEASURED, (0.3, OK), NEVER, "onboard, cloud CloudTimeout", 0.3, 2.0),
    Case("warm-up, cloud fails", WARM_UP, (0.3, OK), (0.2, FAILED), "onboard, cloud TaskFailed", 0.3, None),
    Case("warm-up, onboard fails", WARM_UP, (0.1, FAILED), (0.2, OK), "onboard TaskFailed, cloud", None, 0.2),
    Case(
        *("warm-up, task fails", WARM_UP, (0.3, FAILED), (0.2, FAILED)),
        *("onboard TaskFailed, cloud TaskFailed", None, None),
        answer=OWN,
    ),
    Case(
        *("warm-up, cloud broken and task fails", WARM_UP, (0.3, FAILED), (0.2, BROKEN)),
        *("onboard TaskFailed, cloud CloudBroken", None, 0.2),
        answer=OWN,
    ),
    Case("probe", PROBE, (0.3, OK), (0.2, OK), "onboard Overtaken, cloud", 0.3, 0.2),
    Case("probe slow", PROBE, (0.3, OK), (0.9, OK), "onboard, cloud Overtaken", 0.3, 0.9),
    Case("probe silent", PROBE, (0.3, OK), NEVER, "onboard, cloud Overtaken", 0.3, 2.0),
    Case("probe fails late", PROBE, (0.3, OK), (0.9, FAILED), "onboard, cloud Overtaken", 0.3, None),
    Case(
        *("probe fails first", PROBE, (0.3, OK), (0.2, FAILED)),
        *("onboard Overtaken, cloud TaskFailed", 0.3, None),
        answer=OWN,
    ),
    Case("probe back lost late", PROBE_BACK, (0.3, OK), (0.9, BROKEN), "cloud Overtaken, onboard", 0.3, 0.9),
    Case("hedge in time", HEDGE, (0.3, OK), (0.2, OK), "cloud", None, 0.2, 0),
    Case("hedge, early failure", HEDGE, (0.3, OK), (0.2, FAILED), "cloud TaskFailed", None, None, 0, OWN),
    Case(
        *("hedge, first fails", HEDGE, (0.3, OK), (0.6, FAILED)),
        *("cloud TaskFailed, onboard Overtaken", 0.3, None),
        answer=OWN,
    ),
    Case(
        *("hedge, second fails", HEDGE, (0.1, FAILED), (0.6, OK)),
        *("cloud Overtaken, onboard TaskFailed", None, 0.5),
        answer=OWN,
    ),
    Case("hedge, second wins", HEDGE, (0.1, OK), (0.9, OK), "cloud Overtaken, onboard", 0.1, 0.5),
    Case("hedge, silent", HEDGE, (0.3, OK), NEVER, "cloud Overtaken, onboard", 0.3, 0.7),
    Case("hedge, first wins", HEDGE, (0.3, OK), (0.6, OK), "cloud, onboard Overtaken", 0.3, 0.6),
    Case("hedge, loser fails", HEDGE, (0.3, FAILED), (0.6, OK), "cloud, onboard Overtaken", None, 0.6),
    Case("hedge away, second wins", HEDGE_AWAY, (0.9, OK), (0.1, OK), "onboard Overtaken, cloud", 0.9, 0.1),
    Case("hedge away, first wins", HEDGE_AWAY, (0.6, OK), (0.9, OK), "onboard, cloud Overtaken", 0.6, 0.2),
]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_a_fault_costs_no_answer_and_no_site_learns_a_wrong_time(case: Case) -> None:
    """Answers, records, executions, second runs and learnt times are exactly those of the case."""
    scene = Scene()
    sites = scene.sites
    assert scene.ask(1, Decision(CLOUD, "plain", "scripted")) == 100
    sites[ONBOARD].scripts.append(case.onboard)
    sites[CLOUD].scripts.append(case.cloud)
    assert scene.ask(2, case.decision) == case.answer
    for site in sites.values():
        site.scripts.clear()
    assert scene.ask(3, Decision(CLOUD, "plain", "scripted")) == 300
    scene.clock.run_out()

    assert [(one.size, one.waited_s >= 0) for one in scene.records] == [(1, True), (2, True), (3, True)]
    assert len({one.id for one in scene.records}) == 3
    record = scene.records[1]
    runs = [
        f"{one.site} {type(one.failure).__name__ if one.failure else ''}".strip() for one in record.executions
    ]
    assert ", ".join(runs) == case.runs
    assert (record.used is None) == (case.answer == OWN)
    assert scene.learnt(ONBOARD) == ([] if case.onboard_s is None else [(2, case.onboard_s)])
    cloud_of_2 = [] if case.cloud_s is None else [(2, case.cloud_s)]
    assert sorted(scene.learnt(CLOUD)) == [(1, 0.02), *cloud_of_2, (3, 0.02)]
    assert scene.in_flight() == 0
    assert 3 - scene.allowance.duplicates == case.duplicates
    assert len(sites[ONBOARD].tasks) + len(sites[CLOUD].tasks) == 2 + len(runs)


@pytest.mark.parametrize(
    "decision", [WARM_UP, PROBE, PROBE_BACK, HEDGE, HEDGE_AWAY], ids=lambda one: one.reason
)
@pytest.mark.parametrize("at_s", [0.1, 0.5])
def test_close_ends_the_task_under_way_and_nothing_is_learnt(decision: Decision, at_s: float) -> None:
    """In every phase the caller gets one error, no site learns a time, and no run is left."""
    scene = Scene()
    for site in scene.sites.values():
        site.takes = 1.0
    scene.clock.after(at_s, scene.offload.close)
    assert scene.ask(2, decision) in ("OffloadError", "SiteClosed")
    scene.clock.run_out()
    assert len(scene.records) <= 1
    assert scene.learnt(ONBOARD) == scene.learnt(CLOUD) == []
    assert scene.in_flight() == 0


def test_a_late_run_is_in_the_next_record_with_the_id_of_its_own_task() -> None:
    """The trace has each late run once, with the id of the task that it belongs to."""
    scene = Scene()
    scene.sites[CLOUD].scripts.append((0.7, OK))
    scene.ask(1, PROBE)
    scene.clock.run_out()
    plain = Decision(ONBOARD, "plain", "scripted")
    scene.ask(2, plain)
    scene.ask(3, plain)
    first, second, third = scene.records
    assert first.late == third.late == ()
    (late,) = second.late
    assert (late.id, late.execution.site, late.execution.ok) == (first.id, CLOUD, True)
    assert late.execution.seconds == pytest.approx(0.7)


def test_an_interrupted_call_leaves_nothing_in_flight() -> None:
    """After Ctrl-C during a task, its site does not count as busy."""
    scene = Scene()

    def interrupt() -> None:
        raise KeyboardInterrupt

    scene.clock.after(0.001, interrupt)
    with pytest.raises(KeyboardInterrupt):
        scene.ask(1, HEDGE)
    assert scene.in_flight() == 0
    assert scene.ask(2, WARM_UP) == 200


@pytest.mark.parametrize(
    ("where", "cloud"), [("both", OK), (CLOUD, BROKEN)], ids=["measured on both", "fallback"]
)
def test_only_second_runs_of_the_policy_cost_allowance(where: str, cloud: OffloadError | None) -> None:
    """A measurement on both sites is free, and so is a fallback after a failure."""
    scene = Scene()
    scene.sites[CLOUD].failure = cloud
    for number in range(30):
        scene.offload(phase_echo, number, where=where)
    assert scene.allowance.duplicates == DUPLICATES_MAX


def test_an_overtaken_run_is_no_failure() -> None:
    """A site that lost several hedges in a row has no failures."""
    scene = Scene()
    scene.sites[CLOUD].takes = 1.0
    for number in range(4):
        scene.ask(number, HEDGE)
    assert scene.records[-1].sites[CLOUD].failures == 0
    assert scene.records[-1].sites[CLOUD].predicted_s is not None


FAULTS: list[Callable[[Random], Run]] = [
    lambda rng: (rng.uniform(0.0, 0.3), BROKEN),
    lambda rng: (rng.uniform(0.0, 0.05), BUSY),
    lambda rng: (rng.uniform(0.1, 1.0), LATE),
    lambda _: NEVER,
    lambda rng: (rng.uniform(1.0, 1.9), OK),
]


@pytest.mark.parametrize(
    "policy",
    ["hedge:probe:greedy", "hedge:probe:paper-with-heartbeats", "budget:hedge:probe:greedy", "paper"],
)
@pytest.mark.parametrize("seed", [1, 2])
def test_no_answer_is_lost_among_random_faults(policy: str, seed: int) -> None:
    """With faults of all kinds on three sites, each of 600 tasks is answered once, by its own result."""
    rng, clock = Random(seed), VirtualClock()
    sites = {site: VirtualRunner(site, clock) for site in (ONBOARD, CLOUD, EDGE)}
    records: list[Record] = []
    offload = Offloader(
        list(sites.values()),
        policy=policies.make(policy, seed),
        memories=Settings(window=20).make_memories(policy),
        timeout_s=TIMEOUT_S,
        observers=[records.append],
        clock=clock,
    )
    for number in range(600):
        for site, runner in sites.items():
            runner.scripts.clear()
            runner.takes = rng.uniform(0.05, 0.3)
            if site != ONBOARD and rng.random() < 0.2:
                runner.scripts.append(rng.choice(FAULTS)(rng))
                runner.measured = Condition(rng.uniform(0, 0.1), silent=rng.random() < 0.3)
        assert offload(phase_echo, number) == 100 * number
    clock.run_out()
    offload(phase_echo, 600, where=ONBOARD)
    assert [one.size for one in records] == list(range(601))
    assert all(len({run.site for run in one.executions}) == len(one.executions) for one in records)
    assert not any(offload._flights.count(site) for site in sites)
    overtaken = sum("Overtaken" in (run.error or "") for one in records for run in one.executions)
    assert sum(len(one.late) for one in records) == overtaken
    assert overtaken > 0 or policy == "paper"
    offload.close()
