"""An offloader that only observes: it answers every task onboard, and probes say what others would save."""

from collections.abc import Callable
from random import Random
from statistics import fmean

import pytest

from offboard.common.errors import CloudTimeout
from offboard.common.tasks import task
from offboard.robot_client import policies, predictors
from offboard.robot_client.learning.memories import Memories
from offboard.robot_client.learning.savings import Savings
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.policies import Probe
from offboard.robot_client.policies.allowance import DUPLICATES, DUPLICATES_MAX, Allowance
from offboard.robot_client.policies.objectives import S_PER_QUALITY
from offboard.robot_client.policies.observe import Observe
from offboard.robot_client.policies.probe import PROBE_EVERY
from offboard.robot_client.predictors.base import WARM_UP
from offboard.robot_client.records.record import Record
from offboard.robot_client.settings import Settings
from offboard.robot_client.sites.runner import CLOUD, ONBOARD
from tests.outlooks import decide, known
from tests.policy_checks import CONTRACT, EDGE, SILENT
from tests.virtual import VirtualClock, VirtualRunner

KIND = "observed_echo"
TIMEOUT_S = 2.0


@task(KIND, size=lambda number: number)
def observed_echo(number: float) -> float:
    return number


@task("observed_once", size=lambda: 1.0, duplicate=False)
def observed_once() -> str:
    return "done"


def observed_roughly(number: float) -> float:
    return number


@task(
    "observed_graded",
    size=lambda number: number,
    variants={ONBOARD: observed_roughly},
    quality={ONBOARD: 0.5, CLOUD: 1.0},
)
def observed_graded(number: float) -> float:
    return number


class Robot:
    """A robot that observes in virtual time; a task of size 1 takes a second onboard and `cloud_s` there.

    Probes run in the thread of the caller, because virtual time has only one.
    """

    def __init__(self, cloud_s: float = 0.4, allowance: Allowance | None = None) -> None:
        self.clock, self.random = VirtualClock(), Random(1)
        self.sites = {site: VirtualRunner(site, self.clock) for site in (CLOUD, ONBOARD)}
        self.cloud_s = cloud_s
        self.records: list[Record] = []
        self.offload = Offloader(
            list(self.sites.values()),
            policy=Observe(policies.make(policies.DEFAULT)),
            memories=Memories(lambda: predictors.make(predictors.LEAST_SQUARES, 50)),
            allowance=allowance,
            timeout_s=TIMEOUT_S,
            observers=[self.records.append],
            clock=self.clock,
        )
        self.offload._life.call_beside = lambda call: call()  # type: ignore[assignment, method-assign]

    def call(self) -> float:
        """Run a task; returns what the cloud would have saved."""
        size = self.random.uniform(0.5, 1.5)
        took = {
            site: size * seconds * self.random.uniform(0.9, 1.1)
            for site, seconds in ((ONBOARD, 1.0), (CLOUD, self.cloud_s))
        }
        for site, seconds in took.items():
            self.sites[site].takes = seconds
        assert self.offload(observed_echo, size) == size
        assert self.records[-1].waited_s == pytest.approx(took[ONBOARD])
        return took[ONBOARD] - took[CLOUD]

    def saved(self) -> Savings:
        found = self.offload.savings()[KIND]
        print(found)
        assert found is not None
        return found


@pytest.mark.parametrize("cloud_s", [0.4, 1.6], ids=["faster cloud", "slower cloud"])
def test_every_task_is_answered_onboard_after_its_time_onboard(cloud_s: float) -> None:
    """The cloud runs only probes, within the allowance, and its answers are never used."""
    robot = Robot(cloud_s)
    for _ in range(200):
        robot.call()
    assert {record.used for record in robot.records} == {ONBOARD}
    assert {record.decision.site for record in robot.records} == {ONBOARD}
    assert {len(record.executions) for record in robot.records} == {1}
    assert {late.execution.site for record in robot.records for late in record.late} == {CLOUD}
    assert len(robot.sites[ONBOARD].tasks) == 200
    assert WARM_UP < len(robot.sites[CLOUD].tasks) <= DUPLICATES_MAX + 200 * DUPLICATES
    assert not robot.sites[CLOUD].cancelled


@pytest.mark.parametrize("cloud_s", [0.4, 0.8])
def test_the_true_saving_is_inside_the_interval(cloud_s: float) -> None:
    """Each task would have been sent, and saved what the cloud is faster."""
    robot = Robot(cloud_s)
    true_s = fmean([robot.call() for _ in range(300)])
    found = robot.saved()
    assert found.low_s <= true_s <= found.high_s
    assert found.mean_s == pytest.approx(true_s, rel=0.15)
    assert found.sent > 0.95
    assert found.probes > 20


def test_a_cloud_that_is_slower_saves_nothing() -> None:
    """The policy would have kept the tasks onboard."""
    robot = Robot(1.6)
    for _ in range(100):
        robot.call()
    found = robot.saved()
    assert (found.mean_s, found.sent) == (0.0, 0.0)


def test_a_better_answer_is_worth_its_quality() -> None:
    """The cloud is 0.2 s slower, and its better answers count as 0.5 s: each task would be sent."""
    robot = Robot()
    robot.sites[ONBOARD].takes, robot.sites[CLOUD].takes = 1.0, 1.2
    for _ in range(200):
        robot.offload(observed_graded, 1.0)
    found = robot.offload.savings()["observed_graded"]
    assert found is not None
    assert found.sent > 0.9
    assert found.mean_s == pytest.approx(-0.2, rel=0.15)
    assert found.quality_s == pytest.approx(0.5 * S_PER_QUALITY * found.sent)


def test_the_saving_is_unknown_at_first_and_without_observing() -> None:
    """No task, few probes or another policy: no number is made up."""
    robot = Robot()
    assert robot.offload.savings() == {}
    for _ in range(WARM_UP + 5):
        robot.call()
    assert robot.offload.savings() == {KIND: None}
    with Offloader.connect() as offload:
        offload(observed_echo, 1.0)
        assert offload.savings() == {}


def test_tasks_without_a_server_save_nothing() -> None:
    """If the server is not connected half of the time, the saving per task is half."""
    robot = Robot()
    for _ in range(200):
        robot.call()
    before = robot.saved()
    robot.sites[CLOUD].unavailable = lambda _: "not connected"  # type: ignore[assignment, method-assign, return-value]
    for _ in range(before.tasks):
        robot.call()
    after = robot.saved()
    assert after.mean_s == pytest.approx(before.mean_s / 2)
    assert after.tasks == 2 * before.tasks


def test_a_site_that_fails_costs_its_time() -> None:
    """If the probes fail, offloading would have cost the timeout, and the tasks would run onboard then."""
    robot = Robot()
    for _ in range(100):
        robot.call()
    robot.sites[CLOUD].failure = CloudTimeout("late")
    before_s = robot.saved().mean_s
    for _ in range(100):
        robot.call()
    assert robot.saved().mean_s < before_s


def test_a_task_that_must_not_run_twice_is_only_answered() -> None:
    """Its saving stays unknown, and the cloud never gets it."""
    robot = Robot()
    for _ in range(30):
        assert robot.offload(observed_once) == "done"
    assert not robot.sites[CLOUD].tasks
    assert robot.offload.savings() == {}


def test_a_batch_stays_onboard() -> None:
    """`map` uses no other site unless the caller pins it there."""
    robot = Robot()
    assert robot.offload.map(observed_echo, [1.0, 2.0]) == [1.0, 2.0]
    assert not robot.sites[CLOUD].tasks


def test_a_pinned_call_does_not_count() -> None:
    """`where` is the choice of the caller, and says nothing about the policy."""
    robot = Robot()
    for _ in range(100):
        robot.call()
    before = robot.saved()
    robot.offload(observed_echo, 1.0, where=ONBOARD)
    robot.offload(observed_echo, 1.0, where=CLOUD)
    assert robot.saved() == before


@pytest.mark.parametrize("check", CONTRACT)
def test_observing_is_a_policy_like_any_other(check: Callable[[Callable[[], Observe]], None]) -> None:
    """It keeps the contract of all policies."""
    check(lambda: Observe(policies.make(policies.DEFAULT, seed=3)))


def test_connect_observes_with_the_policy_that_is_named() -> None:
    """`Offloader.connect(observe=True)` wraps it, also if it has caps."""
    for settings in (None, Settings(bytes_a_minute=1e6)):
        with Offloader.connect("tcp://127.0.0.1:9", observe=True, settings=settings) as offload:
            assert isinstance(offload._policy, Observe)
            assert offload(observed_echo, 1.0) == 1.0


def test_a_decision_says_what_the_policy_advises() -> None:
    """The site, its reason, and no site during the warm-up."""
    sites = {ONBOARD: known(0.5), CLOUD: known(0.1)}
    decision = decide(Observe(policies.make("greedy")), sites, duplicates=0.0)
    assert (decision.site, decision.advised, decision.second, decision.policy) == (
        ONBOARD,
        CLOUD,
        None,
        "observe",
    )
    assert decision.reason.startswith("only observed; the policy says cloud: cloud: 100 ms")
    cold = known(0.1, observations=2, full=False)
    warming = decide(Observe(policies.make("greedy")), {ONBOARD: known(0.5), CLOUD: cold})
    assert warming.advised is None
    assert warming.second == Probe(CLOUD, answers=False)
    assert "the policy says all sites: warm-up" in warming.reason


def test_the_advised_site_is_probed_and_a_stale_one_before_it() -> None:
    """A site that ran nothing for PROBE_EVERY tasks comes first; a task that would stay needs no probe."""
    near = known(0.2, age=3)
    observe = Observe(policies.make("greedy"))
    sites = {ONBOARD: known(0.5), CLOUD: known(0.1), EDGE: near}
    assert decide(observe, sites).second == Probe(CLOUD, answers=False)
    stale = near._replace(age=PROBE_EVERY)
    assert decide(observe, sites | {EDGE: stale}).second == Probe(EDGE, answers=False)
    assert decide(observe, {ONBOARD: known(0.1), CLOUD: known(0.5)}).second is None


@pytest.mark.parametrize(
    ("cloud", "left"),
    [
        ({"in_flight": 1}, {}),
        ({"condition": SILENT}, {}),
        ({"bytes": 100.0}, {"bytes_left": 50.0}),
        ({"joules": 2.0}, {"joules_left": 1.0}),
        ({}, {"duplicates": 0.9}),
    ],
)
def test_no_probe_goes_beyond_a_limit(cloud: dict[str, object], left: dict[str, float]) -> None:
    """A busy or silent site is not probed, nor one for which the caps or the allowance leave too little."""
    sites = {ONBOARD: known(0.5), CLOUD: known(0.1, age=PROBE_EVERY, **cloud)}
    assert decide(Observe(policies.make("greedy")), sites, **left).second is None
