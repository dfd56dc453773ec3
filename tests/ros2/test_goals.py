"""A real rclpy client in another process asks the node for paths, onboard and through the cloud."""

import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from offboard.common.planning.maps import GridMap
from offboard.loadgen.robot_files import read_trace
from offboard.loadgen.testbed.local_testbed import LocalTestbed
from tests.ros2.conftest import PLANNER, RELEASES, Process, publish_map
from tests.ros2.goals import ONBOARD_S, PLANS, RADIUS_M, Goal, Result, check_path, goals_on, quantiles_ms

pytestmark = [pytest.mark.ros2, pytest.mark.timeout(300), pytest.mark.parametrize("release", RELEASES)]

Make = Callable[..., Process]
Beds = Callable[..., LocalTestbed]

GOALS = 200
ONE_WAY_MS = 15.0  # a relay of 30 ms
TIMEOUT_S = 0.5
TO_CLOUD = ("--policy", "cloud", "--timeout", str(TIMEOUT_S))
FAR_MS = 200.0
FAR_S = (
    2 * FAR_MS / 1e3
)  # a goal takes at least this long unless it is stopped, which should take below 50 ms
APART_S = 0.1


def check_paths(grid: GridMap, goals: Sequence[Goal], results: Sequence[Result]) -> None:
    for goal, result in zip(goals, results, strict=True):
        assert (result["status"], result["code"], result["message"]) == ("succeeded", "NONE", "")
        check_path(grid, goal, result)


def show(title: str, results: Sequence[Result], trace: Path) -> None:
    """Print what ROS adds, and what we add: the rest of the time is that of the answer used."""
    runs = [
        next(one["seconds"] for one in record["executions"] if one["site"] == record["used"] and one["ok"])
        for record in list(read_trace(trace))[-len(results) :]
    ]
    total, planning = ([result[name] for result in results] for name in ("seconds", "planning_s"))
    ours = [planning_s - run_s for planning_s, run_s in zip(planning, runs, strict=True)]
    ros = [total_s - planning_s for total_s, planning_s in zip(total, planning, strict=True)]
    accepted = [result["accept_s"] for result in results]
    print(f"\n{title}: whole {quantiles_ms(total)}; accepted after {quantiles_ms(accepted)}")
    print(f"  ROS adds {quantiles_ms(ros)}; we add {quantiles_ms(ours)}")


def test_200_goals_get_the_paths_of_the_planner(
    release: str,
    node: Make,
    peer: Make,
    willow: GridMap,
    depot: GridMap,
    testbed: Beds,
    tmp_path: Path,
) -> None:
    """With a cloud 30 ms away, on two maps, every path is that of the planner; the times are printed."""
    bed, trace = testbed(PLANNER, delay_ms=ONE_WAY_MS), tmp_path / "trace.jsonl"
    process = node(release, "--cloud", bed.endpoint, "--trace", str(trace), **PLANS)
    client = peer(release)
    for name, grid in (("Willow", willow), ("depot", depot)):
        publish_map(client, grid, tmp_path)
        client.do("arrive")
        goals = goals_on(grid, GOALS)
        results = client.do("ask", goals=goals, each_s=-1)
        check_paths(grid, goals, results)
        time.sleep(1.0)  # the trace is written twice a second
        show(f"{release}, {name}, {GOALS} goals", results, trace)
    runs = [run for record in read_trace(trace) for run in (*record["executions"], *record["late"])]
    assert {run["site"] for run in runs if run["ok"]} == {"onboard", "cloud"}, process.log()


def test_an_outage_loses_no_goal(release: str, node: Make, peer: Make, depot: GridMap, testbed: Beds) -> None:
    """While the link delivers nothing, each goal is planned within the timeout plus the time onboard."""
    bed = testbed(PLANNER, delay_ms=ONE_WAY_MS)
    process = node(release, "--cloud", bed.endpoint, *TO_CLOUD, **PLANS)
    client, goals = peer(release, depot), goals_on(depot, 60)
    client.do("arrive")
    before = client.do("ask", goals=goals[:25], each_s=-1)
    bed.set_link(outage=True)
    during = client.do("ask", goals=goals[25:35], each_s=-1)
    bed.set_link(outage=False)
    after = client.do("ask", goals=goals[35:], each_s=-1)
    check_paths(depot, goals, before + during + after)
    slowest_s = max(result["seconds"] for result in during)
    print(f"\n{release}: the slowest goal of the outage took {slowest_s * 1e3:.0f} ms")
    assert TIMEOUT_S <= slowest_s <= TIMEOUT_S + ONBOARD_S, process.log()
    assert statistics.median(result["seconds"] for result in after) < TIMEOUT_S


def test_a_killed_server_loses_no_goal(
    release: str, node: Make, peer: Make, depot: GridMap, testbed: Beds
) -> None:
    """If the server dies in the middle, the goals go on onboard, and return when it is there again."""
    bed = testbed(PLANNER, delay_ms=ONE_WAY_MS)
    process = node(release, "--cloud", bed.endpoint, *TO_CLOUD, **PLANS)
    client, goals = peer(release, depot), goals_on(depot, 60)
    client.do("arrive")
    results = client.do("ask", goals=goals[:10], each_s=-1)
    client.send("ask", goals=goals[10:40], each_s=-1)
    time.sleep(0.3)
    bed.kill("cloud")
    results += client.answer()
    bed.start("cloud")
    results += client.do("ask", goals=goals[40:], each_s=-1)
    check_paths(depot, goals, results)
    slowest_s = max(result["seconds"] for result in results)
    print(f"\n{release}: the slowest goal with a killed server took {slowest_s * 1e3:.0f} ms")
    assert slowest_s <= TIMEOUT_S + ONBOARD_S, process.log()


def test_a_new_goal_ends_the_old_one(
    release: str, node: Make, peer: Make, depot: GridMap, testbed: Beds
) -> None:
    """A goal that waits for a slow cloud is aborted as soon as the next one comes."""
    bed = testbed(PLANNER, delay_ms=FAR_MS)
    node(release, "--cloud", bed.endpoint, "--policy", "cloud", "--timeout", "5", **PLANS)
    client, goals = peer(release, depot), goals_on(depot, 7)
    client.do("arrive")
    client.do("ask", goals=goals[:1], each_s=-1)  # the server has the map now
    results = client.do("ask", goals=goals[1:], each_s=APART_S)
    assert [result["status"] for result in results] == ["aborted"] * 5 + ["succeeded"]
    assert results[0]["message"] == "a newer goal replaced this one"
    assert results[-1]["seconds"] >= FAR_S
    late_s = [result["seconds"] - APART_S for result in results[:-1]]
    shown = ", ".join(f"{late * 1e3:.1f}" for late in late_s)
    print(f"\n{release}: replaced goals ended {shown} ms after the next goal")
    assert statistics.median(late_s) <= FAR_S - APART_S


def test_a_canceled_goal_ends(release: str, node: Make, peer: Make, depot: GridMap, testbed: Beds) -> None:
    """A cancel is passed on: the goal ends as canceled, and the next goal is planned."""
    bed = testbed(PLANNER, delay_ms=FAR_MS)
    node(release, "--cloud", bed.endpoint, "--policy", "cloud", "--timeout", "5", **PLANS)
    client, goals = peer(release, depot), goals_on(depot, 6)
    client.do("arrive")
    client.do("ask", goals=goals[:1], each_s=-1)  # the server has the map now
    times_s = []
    for goal in goals[1:]:
        (result,) = client.do("ask", goals=[goal], cancel_s=APART_S)
        assert result["status"] == "canceled"
        times_s.append(result["after_cancel_s"])
    shown = ", ".join(f"{seconds * 1e3:.1f}" for seconds in times_s)
    print(f"\n{release}: canceled goals ended {shown} ms after the cancel")
    assert statistics.median(times_s) <= FAR_S - APART_S
    check_paths(depot, goals[:1], client.do("ask", goals=goals[:1]))


def test_50_goals_at_once_all_end(
    release: str, node: Make, peer: Make, depot: GridMap, testbed: Beds
) -> None:
    """Of 50 goals at once each one ends, and the last one succeeds."""
    bed = testbed(PLANNER, delay_ms=ONE_WAY_MS)
    node(release, "--cloud", bed.endpoint, **PLANS)
    client, goals = peer(release, depot), goals_on(depot, 50)
    client.do("arrive")
    results = client.do("ask", goals=goals)
    assert {result["status"] for result in results} <= {"aborted", "succeeded"}
    ended = max(results, key=lambda result: result["ended_s"])
    assert ended["status"] == "succeeded"
    assert ended["seconds"] <= 5.0


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
    client.do("arrive")
    results = client.do("ask", goals=list(wanted.values()), each_s=-1)
    assert [result["code"] for result in results] == list(wanted)
    assert all(result["message"] for result in results[:-1])
    (lost,) = client.do("ask", goals=[{"x": 1.0, "y": 1.0}])
    assert lost["code"] == "TF_ERROR"
