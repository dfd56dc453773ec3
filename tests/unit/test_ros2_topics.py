"""What messages mean to the planner server: frames, updates, warnings and diagnostics, without ROS."""

import logging
from collections.abc import Iterator
from queue import Queue
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from offboard.common.errors import ConfigError
from offboard.common.planning.maps import GridMap
from offboard.common.planning.planner import Pose, Scan
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.settings import Settings
from offboard.ros2 import converters as ros
from offboard.ros2.parameters import Parameters, read_arguments
from offboard.ros2.planner_server import Outcome
from offboard.ros2.topics import Diagnostics, SameFrames, Topics

WAIT_S = 50.0
PLAIN = ros.Library(lambda name: SimpleNamespace, lambda values: values)  # noqa: ARG005 - one class for all
MAP = ros.Header("map")


class Turned:
    """Knows the map, an odometry frame that is shifted, the robot, and a laser at its front."""

    def of(self, frame: str, seen_from: str) -> Pose | None:
        known = {("odom", "map"): Pose(1.0, 0.0), ("base_link", "map"): Pose(0.5, 0.5, 1.0)}
        known["laser", "base_link"] = Pose(0.2, 0.0)
        return Pose(0.0, 0.0) if frame == seen_from else known.get((frame, seen_from))


@pytest.fixture
def facts() -> Diagnostics:
    return Diagnostics()


@pytest.fixture
def offload(facts: Diagnostics) -> Iterator[Offloader]:
    with Offloader.connect(
        policy="paper", timeout_s=1.0, settings=Settings(window=5), observers=[facts]
    ) as made:
        yield made


def topics(offload: Offloader, facts: Diagnostics, transforms: Any = None) -> Topics:
    return Topics(
        PLAIN,
        offload,
        parameters=Parameters.read(lambda _, default: default),
        facts=facts,
        transforms=transforms or SameFrames(),
    )


def room() -> Any:
    return ros.grid_message(PLAIN, GridMap(np.zeros((40, 40), np.int8), 0.1), MAP)


def goal(x: float, y: float, frame: str = "map") -> Any:
    return ros.stamped_pose(PLAIN, Pose(x, y), ros.Header(frame))


def ask(made: Topics, *poses: Any) -> Outcome:
    outcomes: Queue[Outcome] = Queue()
    made.accept(poses[0], poses[1] if len(poses) > 1 else None, "", outcomes.put)
    return outcomes.get(timeout=WAIT_S)


def test_goals_in_other_frames_are_moved_into_the_map(offload: Offloader, facts: Diagnostics) -> None:
    """With transforms, a goal in the odometry frame and the pose of the robot are found in the map."""
    made = topics(offload, facts, Turned())
    made.see_map(room())
    outcome = ask(made, goal(1.0, 2.0, "odom"))
    assert outcome.status == "NONE"
    np.testing.assert_allclose(outcome.poses[[0, -1], :2], [[0.5, 0.5], [2.0, 2.0]])
    assert ask(made, goal(1.0, 2.0, "kitchen")).status == "TF_ERROR"
    path = made.path(outcome, 5_000_000_001)
    assert (path.header.frame_id, path.header.stamp.sec, path.header.stamp.nanosec) == ("map", 5, 1)
    made.close()


def test_poses_and_scans_in_unknown_frames_are_ignored(
    offload: Offloader, facts: Diagnostics, caplog: pytest.LogCaptureFixture
) -> None:
    """Without transforms only the frames of map and robot count; a warning comes once."""
    made = topics(offload, facts)
    made.see_map(room())
    odometry = SimpleNamespace(header=SimpleNamespace(frame_id="odom"), pose=goal(1, 1))
    made.see_pose(odometry)
    assert ask(made, goal(2.0, 2.0)).status == "TF_ERROR"
    odometry.header.frame_id = "map"
    made.see_pose(odometry)
    assert ask(made, goal(2.0, 2.0)).status == "NONE"
    scan = Scan(np.full(8, 0.6, np.float32), 0.0, 0.785, 5.0)
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            made.see_scan(ros.scan_message(PLAIN, scan, ros.Header("laser")))
    assert [record.message for record in caplog.records] == [
        "scans in frame 'laser' are ignored: its place on the robot is not known; remedy: install tf2_ros"
    ]
    made.close()


def test_a_scan_of_a_mounted_laser_blocks_the_way(offload: Offloader, facts: Diagnostics) -> None:
    """A hit at the goal, seen by the laser at the front, makes the goal occupied."""
    made = topics(offload, facts, Turned())
    made.see_map(room())
    made.see_scan(
        ros.scan_message(PLAIN, Scan(np.array([1.3], np.float32), 0.0, 1.0, 5.0), ros.Header("laser"))
    )
    at = 0.5 + 1.5 * np.cos(1.0), 0.5 + 1.5 * np.sin(1.0)
    outcome = ask(made, goal(*at))
    assert outcome.status == "NONE"
    assert 0.05 < np.hypot(*(outcome.poses[-1, :2] - at)) < 0.3  # it ends next to the hit
    made.close()


def test_updates_that_do_not_fit_are_ignored(
    offload: Offloader, facts: Diagnostics, caplog: pytest.LogCaptureFixture
) -> None:
    """An update changes the map; one that lies outside, or has too few cells, is named once."""
    made = topics(offload, facts)
    made.see_map(room())
    wall = SimpleNamespace(x=20, y=0, width=1, height=40, data=np.full(40, 100, np.int8).tobytes())
    made.update_map(wall)
    here = goal(0.5, 0.5)
    assert ask(made, goal(3.5, 0.5), here).status == "NO_VALID_PATH"
    wall.x = 40
    made.update_map(wall)
    wall.x, wall.height = 0, 41
    made.update_map(wall)
    assert [record.message for record in caplog.records if "update" in record.message] == [
        "an update does not fit the map, and is ignored; remedy: publish the map before it"
    ]
    made.close()


def test_diagnostics_have_the_last_decision(offload: Offloader, facts: Diagnostics) -> None:
    """The array names the node, and holds the facts of the last task."""
    made = topics(offload, facts)
    assert made.diagnostics(0).status[0].message == "no task yet"
    made.see_map(room())
    ask(made, goal(3.5, 0.5), goal(0.5, 0.5))
    (status,) = made.diagnostics(0).status
    assert status.name == "planner_server: offboard"
    assert {pair.key: pair.value for pair in status.values}["site"] == "onboard"
    made.close()


def test_parameters_are_read_from_the_command_line() -> None:
    """Without ROS, `-p NAME:=VALUE` sets the parameters of nav2."""
    read = read_arguments(
        ["--ros-args", "-p", "planner_plugins:=[A,B]", "-p", "A.tolerance:=0.25", "--param", "costmap:=true"]
    )
    assert read.planners == ("A", "B")
    assert read.tolerance_m == 0.25
    assert read.costmap
    assert read_arguments([]).radius_m == 0.1


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["-p", "tolerence:=1"], "no parameter 'tolerence'; known: planner_plugins"),
        (["-p", "robot_radius:=-1"], "robot_radius: -1 is not a distance"),
        (["-p", "robot_radius:=wide"], "robot_radius: 'wide' is not a number"),
        (["-p", "costmap:=yes"], "costmap: 'yes' is not true or false"),
        (["-p", "planner_plugins:=[]"], "planner_plugins: it is empty"),
        (["--params-file", "nav2.yaml"], "--params-file nav2.yaml: only -p NAME:=VALUE"),
    ],
)
def test_wrong_parameters_are_named(words: list[str], line: str) -> None:
    """The line names the parameter, its value and what is allowed."""
    with pytest.raises(ConfigError, match=line.replace("[", r"\[")):
        read_arguments(["--ros-args", *words])
