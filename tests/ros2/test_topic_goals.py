"""Goals and paths by topic: planner nodes and bridges, with peers of both releases and without ROS."""

import time
from collections.abc import Callable
from pathlib import Path

import pytest

from offboard.common.planning.maps import GridMap
from offboard.loadgen.testbed.local_testbed import LocalTestbed
from tests.ros2.conftest import DDS, PLANNER, Process
from tests.ros2.goals import ONBOARD_S, PLANS, check_path, goals_from_one_start, place, quantiles_ms

pytestmark = [pytest.mark.ros2, pytest.mark.timeout(300)]

Make = Callable[..., Process]

GOALS = 100  # on each map
OUTAGE = range(40, 43)  # goals without a link
DEAD = range(60, 63)  # goals without a server
TIMEOUT_S = 0.5
# Servers and their peers.
PAIRS = [
    ("kilted", "kilted"),
    ("jazzy", "jazzy"),
    ("kilted", DDS),
    ("jazzy", DDS),
    (DDS, "kilted"),
    (DDS, "jazzy"),
    (DDS, DDS),
]


@pytest.mark.parametrize(("server", "client"), PAIRS)
def test_goals_by_topic_get_the_paths_of_the_planner(
    server: str,
    client: str,
    topic_node: Make,
    peer: Make,
    willow: GridMap,
    depot: GridMap,
    testbed: Callable[..., LocalTestbed],
    tmp_path: Path,
) -> None:
    """From a cloud 30 ms away, in an outage, with a killed server: every goal gets its path in time."""
    bed = testbed(PLANNER, delay_ms=15.0)
    flags = ("--cloud", bed.endpoint, "--policy", "cloud", "--timeout", str(TIMEOUT_S))
    process, asking = topic_node(server, *flags, **PLANS), peer(client)
    times_s = []
    for grid in (willow, depot):
        place(asking, grid, tmp_path)
        for number, goal in enumerate(goals_from_one_start(grid, GOALS)):
            disturb(bed, number)
            result = asking.do("topic", goal=goal)
            assert result["poses"] is not None, process.log()
            check_path(grid, goal, result)
            times_s.append(result["seconds"])
    print(f"\n{server} for {client}: {quantiles_ms(times_s)}, at most {max(times_s) * 1e3:.0f} ms")
    assert TIMEOUT_S <= max(times_s) <= TIMEOUT_S + ONBOARD_S, process.log()
    assert "reason" in asking.do("told")
    check_other_goals(asking, depot)


def disturb(bed: LocalTestbed, number: int) -> None:
    """Begin and end an outage of the link, and the death of the server."""
    if number in (OUTAGE.start, OUTAGE.stop):
        bed.set_link(outage=number == OUTAGE.start)
    if number == DEAD.start:
        bed.kill("cloud")
    if number == DEAD.stop:
        bed.start("cloud")


def check_other_goals(asking: Process, grid: GridMap) -> None:
    """A goal outside the map gets no plan; of 50 goals at once, the last one gets its plan."""
    assert asking.do("topic", goal={"x": 1e4, "y": 0.0, "yaw": 0.0}, wait_s=0.5)["poses"] is None
    goals = goals_from_one_start(grid, 50)
    for goal in goals:
        asking.do("topic", goal=goal, wait_s=0.0)
    time.sleep(1.0)
    check_path(grid, goals[-1], asking.do("last"))
