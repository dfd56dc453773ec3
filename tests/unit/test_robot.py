"""The simulated robot with the real planner on the Willow map: its world, its requests and its drives."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from offboard.common.errors import ConfigError
from offboard.common.planning import maps, planner
from offboard.common.planning.map_files import read_map
from offboard.common.planning.maps import GridMap
from offboard.common.planning.planner import Plan, Point, Pose, plan_path, size_of_plan
from offboard.loadgen.robot.robot import CANDIDATES, FAILURES_MAX, TRIES_MAX, SimulatedRobot

WILLOW = read_map(Path(__file__).parents[2] / "maps/willow-full-0.05.yaml")
NO_PATH = Plan("NO_VALID_PATH", np.zeros((0, 2), np.int32), np.zeros((0, 2), np.float32), 0.0, 0)
planner.warm()  # compiles before the clock of any test runs
SimulatedRobot(GridMap(np.zeros((30, 30), np.int8), 0.1), seed=0, obstacles=0).request()


@dataclass
class Ride:
    """One request: pose, goal, plan, and the cells that the robot drove."""

    pose: Pose
    goal: Point
    plan: Plan
    driven: NDArray[np.int32]


def run(robot: SimulatedRobot, count: int) -> list[Ride]:
    """Plan and drive `count` requests."""
    done = []
    for _ in range(count):
        _, _, pose, goal, *_ = request = robot.request()
        plan = plan_path(*request)
        done.append(Ride(pose, goal, plan, robot.drive(plan)))
    return done


def changed(robot: SimulatedRobot, done: list[Ride]) -> int:
    """How many plans differ from the plan on the prior map without a scan."""
    blind = [plan_path(WILLOW, None, one.pose, one.goal, robot.radius_m) for one in done]
    return sum(a.cells.tolist() != one.plan.cells.tolist() for a, one in zip(blind, done, strict=True))


def test_scans_change_plans_and_nothing_is_hit() -> None:
    """At least 10 of 100 plans differ from the plan on the prior map, and no driven cell is occupied."""
    robot = SimulatedRobot(WILLOW, seed=1)
    done = run(robot, 100)
    assert 10 <= changed(robot, done) < 100
    driven = np.concatenate([one.driven for one in done])
    assert len(driven) > 10_000
    assert (robot.truth.cells[driven[:, 0], driven[:, 1]] == 0).all()
    assert all((np.abs(np.diff(one.driven, axis=0)).max(axis=1, initial=0) <= 1).all() for one in done)
    assert robot.stops > 0
    assert [one.plan.status for one in done].count("NONE") >= 95


def test_without_obstacles_scans_change_no_plan() -> None:
    """A scan of walls that are on the prior map does not change a plan."""
    robot = SimulatedRobot(WILLOW, seed=1, obstacles=0)
    done = run(robot, 40)
    assert changed(robot, done) <= 1
    assert robot.truth.cells.tolist() == WILLOW.cells.tolist()


def test_the_seed_decides_everything() -> None:
    """One seed always gives the same world and requests, and seeds differ."""

    def story(seed: int) -> list[object]:
        robot = SimulatedRobot(WILLOW, seed=seed)
        done = run(robot, 12)
        rides = [(one.pose, one.goal, one.driven.tolist()) for one in done]
        return [robot.truth.cells.tobytes(), rides]

    first = story(5)
    assert first == story(5)
    assert first[0] != story(6)[0]


def test_goals_are_near_and_far() -> None:
    """Input sizes spread over two orders of magnitude."""
    robot = SimulatedRobot(WILLOW, seed=2)
    sizes = []
    for _ in range(100):
        sizes.append(size_of_plan(*robot.request()))
        robot.drive(NO_PATH)
    low, middle, high = np.quantile(sizes, [0.1, 0.5, 0.9])
    assert low * 5 < middle < high / 2


def test_the_tasks_of_a_jumping_robot_do_not_depend_on_answers() -> None:
    """A jump puts the robot at its goal; requests between jumps do not change later tasks."""

    def story(size: float | None, drives: bool) -> list[object]:
        robot = SimulatedRobot(WILLOW, seed=5, size=size)
        found = []
        for _ in range(10):
            _, scan, pose, goal, *_ = request = robot.request()
            found.append((pose, goal, scan.ranges.tolist()))
            if drives:
                plan_path(*request)
                robot.request()
            robot.jump(size)
            assert (robot.pose.x, robot.pose.y) == (goal.x, goal.y)
        return found

    assert story(None, False) == story(None, True)
    assert story(0.5, False) == story(0.5, True) != story(None, False)
    assert len({pose.yaw for pose, _, _ in story(None, False)}) == 10


def test_the_goal_is_the_candidate_with_the_nearest_size() -> None:
    """With a size, the goal is the candidate whose input size is nearest to it."""
    for wanted in (0.0, 0.05, 0.5, 3.0, 1e9):
        robot, twin = (SimulatedRobot(WILLOW, seed=6, size=wanted) for _ in range(2))
        for _ in range(5):
            twin.pose = Pose(robot.goal.x, robot.goal.y)
            twin._random.bit_generator.state = robot._random.bit_generator.state
            twin._random.uniform()  # the yaw
            points = WILLOW.metres(twin._random.choice(twin._standable, CANDIDATES))
            robot.jump(wanted)
            made = [size_of_plan(WILLOW, None, robot.pose, Point(x, y)) for x, y in points]
            got = size_of_plan(WILLOW, None, robot.pose, robot.goal)
            assert abs(got - wanted) == min(abs(size - wanted) for size in made)


def test_a_second_request_is_the_same() -> None:
    """A request changes only when the robot drives."""
    robot = SimulatedRobot(WILLOW, seed=3)
    first, again = robot.request(), robot.request()
    assert first[1].ranges.tolist() == again[1].ranges.tolist()
    assert (first[2:], first[0]) == (again[2:], WILLOW)


def test_obstacles_stand_in_free_space_that_the_robot_can_reach() -> None:
    """The world is the prior map plus boxes of 0.3 to 1 m; robot and goal stand clear of them."""
    robot = SimulatedRobot(WILLOW, seed=4, obstacles=25)
    added = (robot.truth.cells == 100) & (WILLOW.cells != 100)
    assert 25 * 6**2 / 2 < added.sum() < 25 * 21**2
    assert ((robot.truth.cells == WILLOW.cells) | added).all()
    clear = maps.passable(robot.truth, robot.radius_m)
    for place in (robot.pose, robot.goal):
        cell = WILLOW.cell(place.x, place.y)
        assert cell is not None
        assert clear[cell]


def test_a_blocked_robot_keeps_its_goal_for_some_tries() -> None:
    """The robot stops before a box on its path, and picks another goal after TRIES_MAX tries."""
    cells = np.full((40, 100), 100, np.int8)
    cells[1:-1, 1:-1] = 0
    robot = SimulatedRobot(GridMap(cells, 0.1), seed=1, obstacles=0)
    blocked = cells.copy()
    blocked[1:-1, 50] = 100  # a wall that was not there when the plan was made
    robot.truth = GridMap(blocked, 0.1)
    straight = np.array([[20, col] for col in range(10, 90)], np.int32)
    plan = Plan("NONE", straight, robot.prior.metres(straight).astype(np.float32), 8.0, 1)
    goal = robot.goal
    for n in range(TRIES_MAX):
        assert robot.goal == goal
        assert max(robot.drive(plan)[:, 1], default=0) < 50 - 2
        assert robot.stops == n + 1
    assert robot.goal != goal


def test_the_bumper_stops_before_an_unseen_obstacle() -> None:
    """With a blind LiDAR the robot still stops before the occupied cell."""
    cells = np.full((40, 100), 100, np.int8)
    cells[1:-1, 1:-1] = 0
    robot = SimulatedRobot(GridMap(cells, 0.1), seed=1, obstacles=0, range_max=0.01)
    blocked = cells.copy()
    blocked[1:-1, 50] = 100
    robot.truth = GridMap(blocked, 0.1)
    straight = np.array([[20, col] for col in range(10, 90)], np.int32)
    driven = robot.drive(Plan("NONE", straight, robot.prior.metres(straight).astype(np.float32), 8.0, 1))
    assert driven[-1].tolist() == [20, 49]


def test_goals_without_a_path_lead_to_another_goal_and_then_to_another_place() -> None:
    """Each failure picks a new goal; after FAILURES_MAX the robot is put elsewhere."""
    robot = SimulatedRobot(WILLOW, seed=7)
    start = robot.pose
    for _ in range(FAILURES_MAX - 1):
        goal = robot.goal
        robot.drive(NO_PATH)
        assert robot.goal != goal
        assert robot.pose == start
    robot.drive(NO_PATH)
    assert robot.pose != start


def test_a_map_without_room_is_refused() -> None:
    """The ConfigError names the radius of a robot that fits nowhere."""
    with pytest.raises(ConfigError, match="no room for a robot"):
        SimulatedRobot(GridMap(np.full((9, 9), 100, np.int8), 0.1), seed=0)


def test_boxes_that_leave_no_room_are_named() -> None:
    """On a small free map the boxes take the room: the ConfigError names --obstacles."""
    with pytest.raises(ConfigError, match="--obstacles 0 leaves them out"):
        SimulatedRobot(GridMap(np.zeros((30, 30), np.int8), 0.03), seed=0, obstacles=40)
