"""What the robot publishes changes the plans: pose, scan, map updates, costs; and goals by topic."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from offboard.common.planning.maps import GridMap
from tests.ros2.conftest import RELEASES, Process

pytestmark = [pytest.mark.ros2, pytest.mark.timeout(120)]

Make = Callable[..., Process]

SETTLE_S = 0.7  # latched messages are on their way
FREE = GridMap(np.zeros((60, 60), np.int8), 0.1)
GOAL = {"x": 5.0, "y": 3.0, "yaw": 0.0}


def width_of(answer: dict[str, Any]) -> float:
    """How far a path leaves the straight line."""
    assert answer["poses"], answer
    return max(abs(y - 3.0) for _, y, _ in answer["poses"])


@pytest.mark.parametrize("release", RELEASES)
def test_pose_scan_and_updates_change_the_plan(release: str, node: Make, peer: Make) -> None:
    """The path starts at the robot, and goes round what scan and updates show."""
    process, client = node(release, robot_radius=0.2), peer(release, FREE)
    client.do("pose", x=1.0, y=3.0)
    client.do("ask", goals=[GOAL | {"start": {"x": 1.0, "y": 3.0}}])  # the action is there
    time.sleep(SETTLE_S)
    (straight,) = client.do("ask", goals=[GOAL])
    assert straight["poses"][0][:2] == pytest.approx([1.0, 3.0])
    assert width_of(straight) < 0.11
    client.do("scan", ranges=[1.5 if beam < 10 or beam > 350 else 20.0 for beam in range(360)])
    time.sleep(0.2)
    (around,) = client.do("ask", goals=[GOAL])
    assert width_of(around) > 0.3, process.log()
    time.sleep(1.2)  # the scan is old by then
    (again,) = client.do("ask", goals=[GOAL])
    assert width_of(again) < 0.11
    client.do("update", x=30, y=20, width=2, height=20, value=100)
    time.sleep(SETTLE_S)
    (blocked,) = client.do("ask", goals=[GOAL])
    assert width_of(blocked) > 1.0, process.log()
    facts = client.do("facts")
    assert facts["site"] == "onboard"
    assert float(facts["true_ms"]) > 0
    assert client.do("plans") >= 4


@pytest.mark.parametrize("release", RELEASES)
def test_costs_of_a_costmap_weigh_the_plan(release: str, node: Make, peer: Make) -> None:
    """With nav2's costmap, a dear strip is avoided although it is not occupied."""
    cells = np.zeros((60, 60), np.int8)
    cells[20:40, 28:32] = 90
    node(release, costmap=True)
    client = peer(release, GridMap(cells, 0.1))
    start = {"start": {"x": 1.0, "y": 3.0}}
    client.do("ask", goals=[GOAL | start])
    time.sleep(SETTLE_S)
    (result,) = client.do("ask", goals=[GOAL | start])
    assert width_of(result) > 0.9


@pytest.mark.parametrize("release", RELEASES)
def test_without_nav2_msgs_goals_come_by_topic(release: str, start: Make, peer: Make) -> None:
    """`goal_pose` in, `plan` out, and no plan for a goal that cannot be reached."""
    hidden = "import sys; sys.modules['nav2_msgs'] = None; from offboard.robot_client.__main__ import main; "
    start(release, "-c", f"{hidden}main(['ros2'])")
    client = peer(release, FREE)
    client.do("pose", x=1.0, y=3.0)
    while client.do("topic", goal=GOAL | {"wait_s": 1.0})["poses"] is None:
        pass
    answer = client.do("topic", goal=GOAL)
    assert answer["frame"] == "map"
    assert width_of(answer) < 0.11
    assert client.do("topic", goal=GOAL | {"x": 99.0, "wait_s": 1.0})["poses"] is None
    assert client.do("facts")["site"] == "onboard"


@pytest.mark.parametrize("release", RELEASES)
def test_the_bridge_without_ros_serves_topics(release: str, bridge: Make, peer: Make) -> None:
    """A process with cyclonedds and no ROS answers goals of a real rclpy peer."""
    process, client = bridge(robot_radius=0.2), peer(release, FREE)
    client.do("pose", x=1.0, y=3.0)
    for _ in range(20):
        if client.do("topic", goal=GOAL | {"wait_s": 1.0})["poses"] is not None:
            break
    answer = client.do("topic", goal=GOAL)
    assert answer["poses"], process.log()
    assert width_of(answer) < 0.11
    client.do("scan", ranges=[1.5 if beam < 10 or beam > 350 else 20.0 for beam in range(360)])
    time.sleep(0.2)
    assert width_of(client.do("topic", goal=GOAL)) > 0.3
    assert client.do("facts")["site"] == "onboard"
