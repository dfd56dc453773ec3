"""What the robot publishes changes the plans: pose, scan, map updates and costs."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from offboard.common.planning.maps import GridMap
from tests.ros2.conftest import RELEASES, Process

pytestmark = [pytest.mark.ros2, pytest.mark.timeout(120)]

Make = Callable[..., Process]

FREE = GridMap(np.zeros((60, 60), np.int8), 0.1)
GOAL = {"x": 5.0, "y": 3.0, "yaw": 0.0}
STRAIGHT_M = 0.11  # so far a straight path may be from the line: one cell
TRIES = 40


def width_of(answer: dict[str, Any]) -> float:
    """How far a path leaves the straight line."""
    assert answer["poses"], answer
    return max(abs(y - 3.0) for _, y, _ in answer["poses"])


def asked_until(wide: Callable[[float], bool], ask: Callable[[], dict[str, Any]]) -> None:
    """Ask until the width of the path is right: a message may be lost before each side knows the other."""
    widths = []
    for _ in range(TRIES):
        widths.append(width_of(ask()))
        if wide(widths[-1]):
            return
    pytest.fail(f"widths {widths}")


@pytest.mark.parametrize("release", RELEASES)
def test_pose_scan_and_updates_change_the_plan(release: str, node: Make, peer: Make) -> None:
    """The path starts at the robot, and goes round what scan and updates show; an old scan is forgotten."""
    node(release, robot_radius=0.2)
    client = peer(release, FREE)
    client.do("pose", x=1.0, y=3.0)
    client.do("arrive")

    def ask() -> dict[str, Any]:
        (result,) = client.do("ask", goals=[GOAL])
        assert result["status"] == "succeeded", result
        return dict(result)

    def ask_with_scan() -> dict[str, Any]:
        client.do("scan", ranges=[1.5 if beam < 10 or beam > 350 else 20.0 for beam in range(360)])
        return ask()

    def ask_with_update() -> dict[str, Any]:
        client.do("update", x=30, y=20, width=2, height=20, value=100)
        return ask()

    straight = ask()
    assert straight["poses"][0][:2] == pytest.approx([1.0, 3.0])
    assert width_of(straight) < STRAIGHT_M
    asked_until(lambda width: width > 0.3, ask_with_scan)
    time.sleep(1.2)  # a scan counts for a second
    assert width_of(ask()) < STRAIGHT_M
    asked_until(lambda width: width > 1.0, ask_with_update)
    facts = client.do("told")
    assert facts["site"] == "onboard"
    assert 0 < float(facts["onboard.true_ms"]) <= float(facts["waited_ms"])
    assert width_of(client.do("last")) > 1.0


@pytest.mark.parametrize("release", RELEASES)
def test_costs_of_a_costmap_weigh_the_plan(release: str, node: Make, peer: Make) -> None:
    """Next to nav2's own server, with its costmap: a dear strip is avoided although it is not occupied."""
    cells = np.zeros((60, 60), np.int8)
    cells[20:40, 28:32] = 90
    node(release, costmap=True, action_name="offboard/compute_path_to_pose")
    client = peer(release, GridMap(cells, 0.1), action="offboard/compute_path_to_pose")
    client.do("arrive")
    (result,) = client.do("ask", goals=[GOAL | {"start": {"x": 1.0, "y": 3.0}}])
    assert width_of(result) > 0.9
