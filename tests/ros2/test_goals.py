"""A real rclpy client in another process asks the node for paths, onboard and through the cloud."""

import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from offboard.common.planning.maps import GridMap, free_pairs
from offboard.common.planning.planner import Plan, Point, Pose, plan_path
from offboard.loadgen.robot_files import read_trace
from offboard.loadgen.testbed.local_testbed import LocalTestbed
from tests.ros2.conftest import PLANNER, RELEASES, Process

pytestmark = [pytest.mark.ros2, pytest.mark.timeout(300)]

Make = Callable[..., Process]
Beds = Callable[..., LocalTestbed]

GOALS = 200
RADIUS_M = 0.15
TIMEOUT_S = 0.5
ONBOARD_S = 1.0  # the longest plan onboard, and what ROS adds, on a machine with two busy cores
ACCEPT_S = 0.02
STOP_S = 0.05


def goals_on(grid: GridMap, count: int, seed: int = 1) -> list[dict[str, Any]]:
    """Random goals with starts, between which there is a path."""
    rng = np.random.default_rng(seed)
    metres = grid.metres(free_pairs(grid, count, seed, RADIUS_M).reshape(-1, 2)).reshape(count, 2, 2)
    metres += rng.uniform(-0.4, 0.4, metres.shape) * grid.resolution  # somewhere in the cell
    return [
        {"x": to[0], "y": to[1], "yaw": 0.5, "start": {"x": at[0], "y": at[1]}} for at, to in metres.tolist()
    ]


def planned(grid: GridMap, goal: dict[str, Any]) -> Plan:
    start = Pose(goal["start"]["x"], goal["start"]["y"])
    return plan_path(grid, None, start, Point(goal["x"], goal["y"]), RADIUS_M)


def check_paths(grid: GridMap, goals: list[dict[str, Any]], results: list[dict[str, Any]]) -> None:
    """Each path is that of the planner, within half a cell, and ends as the goal wants."""
    for goal, result in zip(goals, results, strict=True):
        assert (result["status"], result["code"], result["message"]) == ("succeeded", "NONE", "")
        assert result["frame"] == "map"
        poses, own = np.array(result["poses"]), planned(grid, goal).metres
        assert poses.shape == (len(own), 3)
        assert np.abs(poses[:, :2] - own).max() <= grid.resolution / 2 + 1e-4
        assert poses[-1, 2] == pytest.approx(0.5, abs=1e-6)


def quantiles_ms(values: list[float]) -> str:
    cuts = statistics.quantiles(values, n=20)
    return f"P50 {cuts[9] * 1e3:.1f} ms, P95 {cuts[18] * 1e3:.1f} ms"


def show(title: str, results: list[dict[str, Any]], trace: Path) -> None:
    """Print what ROS adds, and what we add: the rest of the time is that of the answer used."""
    runs = [
        next(one["seconds"] for one in record["executions"] if one["site"] == record["used"] and one["ok"])
        for record in list(read_trace(trace))[-len(results) :]
    ]
    total, planning = ([result[name] for result in results] for name in ("seconds", "planning_s"))
    ours = [planning_s - run_s for planning_s, run_s in zip(planning, runs, strict=True)]
    ros = [total_s - planning_s for total_s, planning_s in zip(total, planning, strict=True)]
    print(
        f"\n{title}: whole {quantiles_ms(total)}; ROS adds {quantiles_ms(ros)}; we add {quantiles_ms(ours)};"
    )
    print(f"  accepted {quantiles_ms([result['accept_s'] for result in results])}")


@pytest.mark.parametrize("release", RELEASES)
def test_200_goals_get_the_paths_of_the_planner(
    release: str, node: Make, peer: Make, named_grid: GridMap, testbed: Beds, tmp_path: Path
) -> None:
    """With a cloud 30 ms away, every path is that of the planner; the times are printed."""
    bed, trace = testbed(PLANNER, delay_ms=15.0), tmp_path / "trace.jsonl"
    node(release, "--cloud", bed.endpoint, "--trace", str(trace), robot_radius=RADIUS_M)
    client = peer(release, named_grid)
    goals = goals_on(named_grid, GOALS)
    client.do("ask", goals=goals[:1], each_s=-1)
    results = client.do("ask", goals=goals, each_s=-1)
    check_paths(named_grid, goals, results)
    time.sleep(1.0)  # the trace is written twice a second
    show(f"{release}, {named_grid.cells.shape[1]} x {named_grid.cells.shape[0]} cells", results, trace)
    runs = [run for record in read_trace(trace) for run in record["executions"]]
    assert {run["site"] for run in runs if run["ok"]} == {"onboard", "cloud"}
    assert statistics.median(result["accept_s"] for result in results) <= ACCEPT_S


def test_an_outage_loses_no_goal(node: Make, peer: Make, depot: GridMap, testbed: Beds) -> None:
    """While the link delivers nothing, each goal is planned within the timeout plus the time onboard."""
    bed = testbed(PLANNER, delay_ms=15.0)
    node("kilted", "--cloud", bed.endpoint, "--timeout", str(TIMEOUT_S), robot_radius=RADIUS_M)
    client, goals = peer("kilted", depot), goals_on(depot, 90)
    before = client.do("ask", goals=goals[:30], each_s=-1)
    bed.set_link(outage=True)
    during = client.do("ask", goals=goals[30:60], each_s=-1)
    bed.set_link(outage=False)
    after = client.do("ask", goals=goals[60:], each_s=-1)
    check_paths(depot, goals, before + during + after)
    assert max(result["seconds"] for result in during) <= TIMEOUT_S + ONBOARD_S


def test_a_killed_server_loses_no_goal(node: Make, peer: Make, depot: GridMap, testbed: Beds) -> None:
    """If the server dies in the middle, the goals go on onboard, and go back when it is there again."""
    bed = testbed(PLANNER, delay_ms=15.0)
    process = node("kilted", "--cloud", bed.endpoint, "--timeout", str(TIMEOUT_S), robot_radius=RADIUS_M)
    client, goals = peer("kilted", depot), goals_on(depot, 60)
    client.send("ask", goals=goals[:40], each_s=-1)
    time.sleep(1.0)
    bed.kill("cloud")
    results = client.answer()
    bed.start("cloud")
    results += client.do("ask", goals=goals[40:], each_s=-1)
    check_paths(depot, goals, results)
    assert max(result["seconds"] for result in results) <= TIMEOUT_S + ONBOARD_S, process.log()


def test_a_new_goal_ends_the_old_one_within_50_ms(
    node: Make, peer: Make, depot: GridMap, testbed: Beds
) -> None:
    """A goal that waits for a slow cloud is aborted as soon as the next one comes."""
    bed = testbed(PLANNER, delay_ms=500.0)
    node("kilted", "--cloud", bed.endpoint, "--policy", "cloud", "--timeout", "5", robot_radius=RADIUS_M)
    client, goals = peer("kilted", depot), goals_on(depot, 6)
    client.do("ask", goals=goals[:1], each_s=-1)
    results = client.do("ask", goals=goals, each_s=0.2)
    assert [result["status"] for result in results] == ["aborted"] * 5 + ["succeeded"]
    assert results[0]["message"] == "a newer goal replaced this one"
    late_s = [result["seconds"] - 0.2 for result in results[:-1]]
    print(f"\nended after the next goal: {[f'{late * 1e3:.1f} ms' for late in late_s]}")
    assert statistics.median(late_s) <= STOP_S


def test_a_canceled_goal_ends_within_50_ms(node: Make, peer: Make, depot: GridMap, testbed: Beds) -> None:
    """A cancel is passed on: the goal ends as canceled, and the server stops its run."""
    bed = testbed(PLANNER, delay_ms=500.0)
    node("kilted", "--cloud", bed.endpoint, "--policy", "cloud", "--timeout", "5", robot_radius=RADIUS_M)
    client, goals = peer("kilted", depot), goals_on(depot, 5)
    client.do("ask", goals=goals[:1], each_s=-1)
    times = []
    for goal in goals:
        (result,) = client.do("ask", goals=[goal], cancel_s=0.1)
        assert result["status"] == "canceled"
        times.append(result["after_cancel_s"])
    print(f"\nended after the cancel: {[f'{seconds * 1e3:.1f} ms' for seconds in times]}")
    assert statistics.median(times) <= STOP_S
    check_paths(depot, goals[:1], client.do("ask", goals=goals[:1]))


def test_50_goals_at_once_all_end(node: Make, peer: Make, depot: GridMap, testbed: Beds) -> None:
    """Of 50 goals at once each one ends, and the last one succeeds."""
    bed = testbed(PLANNER, delay_ms=15.0)
    node("kilted", "--cloud", bed.endpoint, robot_radius=RADIUS_M)
    client, goals = peer("kilted", depot), goals_on(depot, 51)
    client.do("ask", goals=goals[:1], each_s=-1)
    results = client.do("ask", goals=goals[1:])
    assert {result["status"] for result in results} <= {"aborted", "succeeded"}
    ended = max(results, key=lambda result: result["ended_s"])
    assert ended["status"] == "succeeded"
    assert ended["seconds"] <= 5.0


@pytest.mark.parametrize("release", RELEASES)
def test_goals_that_cannot_be_reached_get_the_codes_of_nav2(release: str, node: Make, peer: Make) -> None:
    """Each code comes for its reason, and before the map a code that starts nav2's recovery."""
    cells = np.zeros((40, 40), np.int8)
    cells[20:30, 20:30] = 100
    cells[22:28, 22:28] = 0
    node(release, robot_radius=RADIUS_M, GridBased__tolerance=0.0)
    client, here = peer(release), {"x": 0.5, "y": 0.5}
    (early,) = client.do("ask", goals=[{"x": 1.0, "y": 1.0, "start": here}])
    assert (early["status"], early["code"]) == ("aborted", "TIMEOUT")
    client.close()
    client = peer(release, GridMap(cells, 0.1))
    wanted = {
        "GOAL_OUTSIDE_MAP": {"x": 9.0, "y": 0.5, "start": here},
        "START_OUTSIDE_MAP": {"x": 1.0, "y": 0.5, "start": {"x": -3.0, "y": 0.0}},
        "GOAL_OCCUPIED": {"x": 2.5, "y": 2.1, "start": here},
        "START_OCCUPIED": {"x": 1.0, "y": 0.5, "start": {"x": 2.1, "y": 2.1}},
        "NO_VALID_PATH": {"x": 2.5, "y": 2.5, "start": here},
        "TF_ERROR": {"x": 1.0, "y": 1.0, "frame": "odom", "start": here},
        "INVALID_PLANNER": {"x": 1.0, "y": 1.0, "planner": "Smac", "start": here},
        "NONE": {"x": 3.5, "y": 0.5, "start": here},
    }
    time.sleep(0.5)  # the latched map is on its way
    results = client.do("ask", goals=list(wanted.values()), each_s=-1)
    assert [result["code"] for result in results] == list(wanted)
    assert all(result["message"] for result in results[:-1])
    (lost,) = client.do("ask", goals=[{"x": 1.0, "y": 1.0}])
    assert lost["code"] == "TF_ERROR"
