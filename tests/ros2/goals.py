"""Goals on a map, the paths that they must get, and figures of the times that they took."""

import statistics
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from offboard.common.planning.maps import GridMap, free_pairs
from offboard.common.planning.planner import Plan, Point, Pose, plan_path
from tests.ros2.conftest import Process, publish_map

RADIUS_M = 0.15
PLANS = {"robot_radius": RADIUS_M, "GridBased__allow_unknown": False}  # as `planned` plans
ONBOARD_S = 1.0  # more than the longest plan onboard, and what ROS adds, on a busy machine
TRIES = 60
YAW = 0.5

Goal = dict[str, Any]
Result = dict[str, Any]


@cache
def goals_on(grid: GridMap, count: int, seed: int = 1) -> list[Goal]:
    """Random goals with starts, between which there is a path."""
    rng = np.random.default_rng(seed)
    metres = grid.metres(free_pairs(grid, count, seed, RADIUS_M).reshape(-1, 2)).reshape(count, 2, 2)
    metres += rng.uniform(-0.4, 0.4, metres.shape) * grid.resolution  # somewhere in the cell
    return [
        {"x": to[0], "y": to[1], "yaw": YAW, "start": {"x": at[0], "y": at[1]}} for at, to in metres.tolist()
    ]


@cache
def goals_from_one_start(grid: GridMap, count: int) -> list[Goal]:
    """Random goals that can be reached from the same start."""
    (first,) = goals_on(grid, 1, seed=2)
    found = [goal | {"start": first["start"]} for goal in goals_on(grid, 2 * count)]
    return [goal for goal in found if planned(grid, goal).status == "NONE"][:count]


def planned(grid: GridMap, goal: Goal) -> Plan:
    start, end = Pose(goal["start"]["x"], goal["start"]["y"]), Point(goal["x"], goal["y"])
    return _planned(grid, start, end)


@cache
def _planned(grid: GridMap, start: Pose, end: Point) -> Plan:
    return plan_path(grid, None, start, end, RADIUS_M)


def place(client: Process, grid: GridMap, folder: Path) -> None:
    """Let a peer publish a map, and the pose of `goals_from_one_start`; wait until its goals are heard."""
    (first,) = goals_from_one_start(grid, 1)
    publish_map(client, grid, folder)
    client.do("pose", **first["start"])
    client.do("arrive")
    for _ in range(TRIES):
        if client.do("topic", goal=first, wait_s=1.0)["poses"] is not None:
            return
    pytest.fail("no plan")


def check_path(grid: GridMap, goal: Goal, result: Result) -> None:
    """The path is that of the planner, within half a cell, and ends as the goal wants."""
    assert result["frame"] == "map"
    poses, own = np.array(result["poses"]), planned(grid, goal).metres
    assert poses.shape == (len(own), 3)
    assert np.abs(poses[:, :2] - own).max() <= grid.resolution / 2 + 1e-4
    assert poses[-1, 2] == pytest.approx(YAW, abs=1e-6)


def quantiles_ms(seconds: list[float]) -> str:
    cuts = statistics.quantiles(seconds, n=20)
    return f"P50 {cuts[9] * 1e3:.1f} ms, P95 {cuts[18] * 1e3:.1f} ms"
