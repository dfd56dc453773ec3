"""The first calls of a kind: the first good answer is used, and no caller waits for a site that is not known.

Time is virtual.
"""

from collections.abc import Iterator

import pytest

from offboard.common.tasks import task
from offboard.robot_client import policies
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.policies import Outlook
from offboard.robot_client.predictors.base import WARM_UP
from offboard.robot_client.records.record import Record
from offboard.robot_client.settings import Settings
from offboard.robot_client.sites.runner import CLOUD, ONBOARD
from tests.outlooks import UNKNOWN, decide, known
from tests.virtual import VirtualClock, VirtualRunner

EDGE = "edge"
FAST_S, SLOW_S = 0.008, 0.81
BUSY = Outlook(in_flight=1, under_way=True)


@task("first_call", size=lambda number: 1.0)  # noqa: ARG005
def first_call(number: int) -> int:
    return number


class Robot:
    """A robot in virtual time, and the records of its calls."""

    def __init__(self, policy: str = policies.DEFAULT, **takes: float) -> None:
        self.clock = VirtualClock()
        self.sites = {site: VirtualRunner(site, self.clock, seconds) for site, seconds in takes.items()}
        self.records: list[Record] = []
        settings = Settings(window=WARM_UP)
        self.offload = Offloader(
            list(self.sites.values()),
            policy=settings.make_policy(policy),
            memories=settings.make_memories(policy),
            clock=self.clock,
            observers=[self.records.append],
        )

    def calls(self, count: int) -> Iterator[Record]:
        for number in range(count):
            self.offload(first_call, number)
            yield self.records[-1]

    def observations(self, site: str) -> int:
        return self.records[-1].sites[site].observations


@pytest.mark.parametrize(
    ("slow", "fast"),
    [((CLOUD, SLOW_S), (ONBOARD, FAST_S)), ((ONBOARD, SLOW_S), (CLOUD, FAST_S))],
    ids=["slow cloud", "slow onboard"],
)
def test_each_first_call_takes_what_the_faster_site_takes(
    slow: tuple[str, float], fast: tuple[str, float]
) -> None:
    """Nobody waits for the slower site, which becomes known by six runs of its own all the same."""
    robot = Robot(**dict([slow, fast]))
    for record in robot.calls(2 * WARM_UP * round(SLOW_S / FAST_S)):
        assert record.waited_s == pytest.approx(fast[1])
        assert record.used == fast[0]
    assert robot.observations(slow[0]) >= WARM_UP
    assert robot.observations(fast[0]) >= WARM_UP


def test_a_site_runs_one_task_of_its_warm_up_at_a_time() -> None:
    """While its first run is under way, it gets no other one, and no task goes there alone."""
    robot = Robot(cloud=SLOW_S, onboard=FAST_S)
    list(robot.calls(100))
    assert len(robot.sites[CLOUD].tasks) == 1
    assert len(robot.sites[ONBOARD].tasks) == 100


def test_paper_waits_for_both_sites() -> None:
    """Algorithm 1 measures each task of its warm-up on both sites before the next one begins."""
    robot = Robot("paper", cloud=SLOW_S, onboard=FAST_S)
    for record in robot.calls(WARM_UP):
        assert record.waited_s == pytest.approx(SLOW_S)
        assert [one.ok for one in record.executions] == [True, True]
        assert record.decision.waits


def test_two_servers_become_known_one_after_the_other() -> None:
    """A task runs onboard and on one server, never on two servers at once; all become known."""
    robot = Robot(cloud=0.5, edge=0.3, onboard=FAST_S)
    for record in robot.calls(2_000):
        assert record.waited_s == pytest.approx(FAST_S)
        assert not {CLOUD, EDGE} <= {one.site for one in record.executions}
        if record.decision.both:  # and not when a site is probed
            unknown = [one for one in (CLOUD, EDGE) if record.sites[one].observations < WARM_UP]
            assert not any(record.sites[site].under_way for site in unknown)
    assert min(robot.observations(site) for site in (CLOUD, EDGE, ONBOARD)) >= WARM_UP


def test_a_dead_server_costs_the_first_calls_nothing() -> None:
    """Onboard answers, and after six failed runs the server is only probed."""
    robot = Robot(cloud=SLOW_S, onboard=FAST_S)
    robot.sites[CLOUD].takes = None
    for record in robot.calls(3_000):
        assert record.waited_s == pytest.approx(FAST_S)
    assert sum(record.decision.both for record in robot.records) <= WARM_UP
    assert record.sites[CLOUD].given_up


@pytest.mark.parametrize(
    ("cloud", "onboard", "sites"),
    [
        (UNKNOWN, UNKNOWN, {CLOUD, ONBOARD}),
        (BUSY, UNKNOWN, {ONBOARD}),
        (UNKNOWN, BUSY, {CLOUD}),
        (BUSY, BUSY, {ONBOARD}),
        (BUSY, known(0.5, observations=1, full=False), {CLOUD, ONBOARD} - {CLOUD}),
        (known(0.1, observations=3, full=False), BUSY, {CLOUD}),
        (known(0.1), UNKNOWN, {CLOUD, ONBOARD}),
        (known(0.1), BUSY, {CLOUD}),
        (UNKNOWN, known(0.5, in_flight=1), {ONBOARD}),
    ],
)
def test_a_task_goes_where_something_is_known(cloud: Outlook, onboard: Outlook, sites: set[str]) -> None:
    """A site that is not known and busy with its first run gets no task; a free one may run it too."""
    decision = decide("greedy", {CLOUD: cloud, ONBOARD: onboard})
    chosen = {CLOUD, ONBOARD} - set(decision.spared) if decision.both else {decision.site}
    assert chosen == sites, decision


def test_a_busy_server_is_still_tried_by_a_new_kind() -> None:
    """Tasks of other kinds that always run there do not keep a new kind away."""
    busy = Outlook(in_flight=7)
    assert decide("greedy", {CLOUD: busy, ONBOARD: known(0.1)}).both
