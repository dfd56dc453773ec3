"""Three sites, each failing in turn: which of them the default policy uses, in virtual time."""

from collections.abc import Callable
from random import Random

import pytest

from offboard.common.tasks import task
from offboard.robot_client.policies.probe import PROBE_EVERY
from offboard.robot_client.settings import Settings
from offboard.robot_client.sites.runner import CLOUD, ONBOARD
from offboard.testing import Bench
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
    random = Random(seed)

    def seconds(site: str, slowed: float = 1.0) -> Callable[[float], float]:
        trip_s, work_s = SITES[site]
        return lambda size: slowed * random.uniform(1 - NOISE, 1 + NOISE) * (trip_s + work_s * size)

    with Bench(
        onboard_s=seconds(ONBOARD),
        cloud_s=seconds(CLOUD),
        sites={EDGE: seconds(EDGE)},
        timeout_s=TIMEOUT_S,
        settings=Settings(heartbeats=heartbeats),
    ) as bench:
        for site, server in bench.sites.items():
            server.round_trip_s = SITES[site][0]
        for failing, _ in PHASES:
            for site, server in bench.sites.items():
                server.dead() if site in failing else server.back()
            if ONBOARD in failing:
                bench.onboard.slow(seconds(ONBOARD, SLOWED))
            else:
                bench.onboard.back()
            for _ in range(TASKS):
                bench.offload(sized, random.uniform(0.8, 1.2))
    check(bench.records, within)


def test_a_switch_point_is_the_first_task_after_which_most_are_right() -> None:
    """Two other sites in ten tasks count as tries, three do not; a sequence that is too short has none."""
    assert switch_point(["a"] * 10, "a") == 0
    assert switch_point(["b"] * 5 + ["a"] * 20, "a") == 5
    assert switch_point(["b"] * 2 + ["a"] * 20 + ["b"] + ["a"] * 9, "a") == 2
    assert switch_point(["a"] * 10 + ["b"] * 3 + ["a"] * 20, "a") == 13
    assert switch_point(["b"] * 20 + ["a"] * 9, "a") is None
