"""Three sites, each failing in turn: which of them the default policy uses, with scripted sites."""

from random import Random

import pytest

from offboard.common.errors import CloudTimeout
from offboard.common.tasks import Task, task
from offboard.robot_client import policies
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.policies.probe import PROBE_EVERY
from offboard.robot_client.records.record import Record
from offboard.robot_client.settings import Settings
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, Condition, Execution
from tests.fakes import ScriptedRunner
from tests.phases import EDGE, PHASES, TASKS, WITHIN, check, switch_point

TIMEOUT_S = 0.5
SLOWED = 10.0  # times as long: how onboard fails
NOISE = 0.1
SITES = {EDGE: (0.01, 0.033), CLOUD: (0.08, 0.017), ONBOARD: (0.0, 0.15)}  # round trip, seconds for size 1


@task("sized", size=lambda size: size)
def sized(size: float) -> float:
    return size


@pytest.mark.parametrize(("heartbeats", "within"), [(True, WITHIN), (False, 2 * PROBE_EVERY)])
@pytest.mark.parametrize("seed", range(5))
def test_the_best_living_site_is_used_soon_after_each_change(
    seed: int, heartbeats: bool, within: int
) -> None:
    """Within thirty tasks where heartbeats tell that a server is silent; else within two probes.

    A failing server is a timeout, a failing onboard is slow. One probe of a site that is back does not
    outweigh the timeouts that were learnt of it; a second one does.
    """
    random, failing = Random(seed), set[str]()

    def execution(site: str, one: Task) -> Execution:
        trip_s, work_s = SITES[site]
        if site in failing and site != ONBOARD:
            return Execution(site, TIMEOUT_S, failure=CloudTimeout("late"), censored=True)
        slowed = (SLOWED if site in failing else 1.0) * random.uniform(1 - NOISE, 1 + NOISE)
        run_s = slowed * work_s * one.size
        seconds = slowed * trip_s + run_s
        return Execution(site, seconds, one.args[0], queue_s=0.0, run_s=run_s)

    def runner(site: str) -> ScriptedRunner:
        return ScriptedRunner(site, lambda one: execution(site, one))

    records: list[Record] = []
    servers = [runner(EDGE), runner(CLOUD)]
    with Offloader(
        [*servers, runner(ONBOARD)],
        policy=policies.make(policies.DEFAULT),
        memories=Settings().make_memories(policies.DEFAULT),
        observers=[records.append],
    ) as offload:
        for fail, _ in PHASES:
            failing = set(fail)
            for one in servers:
                silent = heartbeats and one.site in failing
                one.measured = Condition(SITES[one.site][0], silent=silent, wait_s=float(silent))
            for _ in range(TASKS):
                offload(sized, random.uniform(0.8, 1.2))
    check(records, within)


def test_a_switch_point_is_the_first_task_after_which_most_are_right() -> None:
    """Two other sites in ten tasks count as tries, three do not; a sequence that is too short has none."""
    assert switch_point(["a"] * 10, "a") == 0
    assert switch_point(["b"] * 5 + ["a"] * 20, "a") == 5
    assert switch_point(["b"] * 2 + ["a"] * 20 + ["b"] + ["a"] * 9, "a") == 2
    assert switch_point(["a"] * 10 + ["b"] * 3 + ["a"] * 20, "a") == 13
    assert switch_point(["b"] * 20 + ["a"] * 9, "a") is None
