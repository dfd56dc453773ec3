"""What an offloader expects of a call before it is made."""

from random import Random

import numpy as np
import pytest

from offboard.common.errors import ConfigError
from offboard.common.tasks import task
from offboard.robot_client import policies
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.policies.allowance import Allowance
from offboard.robot_client.policies.expectation import Expectation
from offboard.robot_client.policies.prediction_errors import ERRORS_MIN
from offboard.robot_client.settings import Settings
from offboard.robot_client.sites.runner import CLOUD, ONBOARD
from offboard.testing import Bench
from tests.virtual import VirtualClock, VirtualRunner

ONBOARD_S, CLOUD_S = 0.1, 0.05  # of a task of size 1
NOISE = 0.2
GROUPS = 5


@task("expected_echo", size=lambda number: number)
def expected_echo(number: float) -> float:
    return number


class Robot:
    """A robot with two sites in virtual time, whose times vary."""

    def __init__(self) -> None:
        self.clock = VirtualClock()
        self.sites = {site: VirtualRunner(site, self.clock) for site in (CLOUD, ONBOARD)}
        self.allowance = Allowance()
        self.random = Random(1)
        self.offload = Offloader(
            list(self.sites.values()),
            policy=policies.make(policies.DEFAULT),
            memories=Settings().make_memories(policies.DEFAULT),
            allowance=self.allowance,
            clock=self.clock,
        )

    def call(self, size: float, where: str | None = None) -> float:
        """Run a task; returns what it took on the site where it was pinned."""
        took = {}
        for site, seconds in ((CLOUD, CLOUD_S), (ONBOARD, ONBOARD_S)):
            took[site] = self.sites[site].takes = seconds * size * self.random.lognormvariate(0.0, NOISE)
        self.offload(expected_echo, size, where=where)
        return took.get(where or "", 0.0)


@pytest.fixture
def robot() -> Robot:
    return Robot()


def test_nothing_is_known_before_the_first_call(robot: Robot) -> None:
    """Each site has an expectation, and it is empty."""
    expected = robot.offload.expect(expected_echo, 1.0, deadline_s=1.0)
    assert expected == {CLOUD: Expectation(), ONBOARD: Expectation()}
    assert str(expected[CLOUD]) == "unknown"


def test_it_says_what_the_next_call_is_decided_from(robot: Robot) -> None:
    """Times and intervals are those of the outlooks that the next call records."""
    for _ in range(30):
        robot.call(robot.random.uniform(0.5, 2.0), robot.random.choice([CLOUD, ONBOARD]))
    expected = robot.offload.expect(expected_echo, number=1.5)
    robot.call(1.5)
    assert robot.offload.last is not None
    for site, outlook in robot.offload.last.sites.items():
        assert expected[site].seconds == outlook.predicted_s
        assert expected[site].interval == (outlook.low_s, outlook.high_s)
        assert expected[site].in_time is None


def test_asking_runs_and_counts_nothing(robot: Robot) -> None:
    """After fifty questions, ages, allowance, record and expectation are the same, and no site got a task."""
    for _ in range(12):
        robot.call(1.0, ONBOARD)
    before = robot.offload.expect(expected_echo, 1.0)
    last, duplicates = robot.offload.last, robot.allowance.duplicates
    ran = [len(site.tasks) for site in robot.sites.values()]
    for _ in range(50):
        assert robot.offload.expect(expected_echo, 1.0) == before
    assert robot.offload.last is last
    assert robot.allowance.duplicates == duplicates
    assert [len(site.tasks) for site in robot.sites.values()] == ran
    robot.call(1.0, ONBOARD)
    assert robot.offload.last is not None
    assert robot.offload.last.sites[CLOUD].age == 12


def test_a_site_that_cannot_take_the_task_says_why() -> None:
    """Its expectation has the reason, and prints as it."""
    with Bench(onboard_s=0.1) as bench:
        bench.cloud.gone()
        for _ in range(3):
            bench.offload(expected_echo, 1.0)
        expected = bench.offload.expect(expected_echo, 1.0)
    assert expected[CLOUD] == Expectation(absent="not connected")
    assert str(expected[CLOUD]) == "not connected"
    assert expected[ONBOARD].seconds == pytest.approx(0.1)
    assert {one.site for record in bench.records for one in record.executions} == {ONBOARD}


@pytest.mark.parametrize("calls", [ERRORS_MIN // 2, 3 * ERRORS_MIN])
def test_a_later_deadline_is_met_more_often(robot: Robot, calls: int) -> None:
    """The probability grows with the deadline, from few errors (by the spread) and from many."""
    for _ in range(calls):
        robot.call(1.0, ONBOARD)
    deadlines = (0.2 * ONBOARD_S, ONBOARD_S, 5 * ONBOARD_S)
    chances = [robot.offload.expect(expected_echo, 1.0, deadline_s=one)[ONBOARD].in_time for one in deadlines]
    found = [one for one in chances if one is not None]
    print(found)
    assert len(found) == 3
    assert found[0] < 0.1 < 0.2 < found[1] < 0.8 < 0.9 < found[2]


def test_intervals_and_probabilities_are_calibrated(robot: Robot) -> None:
    """The interval holds 85 to 95 % of the times, and deadlines are met as often as expected, to 5 points."""
    held, chances, met = [], [], []
    for number in range(1_200):
        site, size = (ONBOARD, CLOUD)[number % 2], robot.random.uniform(0.5, 2.0)
        usual_s = size * (ONBOARD_S if site == ONBOARD else CLOUD_S)
        deadline_s = usual_s * robot.random.uniform(0.6, 1.5)
        expected = robot.offload.expect(expected_echo, size, deadline_s=deadline_s)[site]
        took_s = robot.call(size, site)
        if expected.interval is None or expected.in_time is None:
            continue
        held.append(expected.interval[0] <= took_s <= expected.interval[1])
        chances.append(expected.in_time)
        met.append(took_s <= deadline_s)
    order = np.array_split(np.argsort(chances), GROUPS)
    errors = [abs(np.mean(np.array(chances)[one]) - np.mean(np.array(met)[one])) for one in order]
    print(f"{np.mean(held):.1%} held, errors {errors}")
    assert len(held) > 1_150
    assert 0.85 <= np.mean(held) <= 0.95
    assert np.mean(errors) <= 0.05


@pytest.mark.parametrize("deadline_s", [0.0, -1.0, float("nan"), "1"])
def test_a_deadline_is_a_time_above_zero(robot: Robot, deadline_s: float) -> None:
    """Both a question and a call refuse anything else, and name it."""
    said = f"deadline_s {deadline_s!r}: must be a number above 0, at most"
    with pytest.raises(ConfigError, match=said):
        robot.offload.expect(expected_echo, 1.0, deadline_s=deadline_s)
    with pytest.raises(ConfigError, match=said):
        robot.offload(expected_echo, 1.0, deadline_s=deadline_s)


def test_an_expectation_reads_well() -> None:
    """It prints its time, its interval and its probability."""
    assert str(Expectation(0.25, (0.2, 0.31), 0.124)) == "250 ms [200, 310], in time with 12%"
    assert str(Expectation(0.25)) == "250 ms"
