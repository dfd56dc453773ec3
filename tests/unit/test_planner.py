"""The task `plan_path`: which cells are blocked, the statuses, and the maps kept between requests."""

import gc
import math
import subprocess
import sys
import threading
import weakref
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from offboard.common.planning import maps, planner, search
from offboard.common.planning.map_files import read_map
from offboard.common.planning.maps import GridMap
from offboard.common.planning.planner import Plan, Point, Pose, Scan, plan_path
from offboard.common.tasks import kind_of
from tests.extras import needs

ROOT = Path(__file__).parents[2]
planner.warm()  # compile now, so that the timeout of no test includes it


def room(height: int = 40, width: int = 60, resolution: float = 0.1) -> GridMap:
    """An empty room with walls."""
    cells = np.full((height, width), 100, np.int8)
    cells[1:-1, 1:-1] = 0
    return GridMap(cells, resolution)


def one_beam(range_m: float, angle: float = 0.0) -> Scan:
    return Scan(np.array([range_m], np.float32), angle, 0.0, 5.0)


@pytest.mark.parametrize(
    ("pose", "goal", "status"),
    [
        (Pose(1.0, 1.0), Point(4.0, 3.0), "NONE"),
        (Pose(-0.01, 1.0), Point(4.0, 3.0), "START_OUTSIDE_MAP"),
        (Pose(1.0, 4.01), Point(4.0, 3.0), "START_OUTSIDE_MAP"),
        (Pose(1.0, 1.0), Point(6.01, 3.0), "GOAL_OUTSIDE_MAP"),
        (Pose(0.25, 1.0), Point(4.0, 3.0), "START_OCCUPIED"),
        (Pose(1.0, 1.0), Point(5.8, 3.0), "GOAL_OCCUPIED"),
    ],
)
def test_statuses_have_the_names_of_nav2(pose: Pose, goal: Point, status: str) -> None:
    """Each reason for having no path has its own status, and an empty path."""
    plan = plan_path(room(), None, pose, goal, 0.2)
    assert plan.status == status
    assert (len(plan.cells) > 0) == (len(plan.metres) > 0) == (plan.cost > 0) == (status == "NONE")


def test_walled_off_goals_have_no_valid_path() -> None:
    """Behind a wall across the room the status is NO_VALID_PATH, and `expanded` counts the reached cells."""
    cells = room().cells.copy()
    cells[:, 30] = 100
    plan = plan_path(GridMap(cells, 0.1), None, Pose(1.0, 1.0), Point(5.0, 3.0), 0.0)
    assert (plan.status, plan.expanded) == ("NO_VALID_PATH", 38 * 29)


@pytest.mark.parametrize("yaw", [0.0, 0.6])
def test_a_plan_is_in_cells_and_in_the_map_frame(yaw: float) -> None:
    """`metres` are the centres of the cells for any origin, and the cost is the length of the path."""
    grid = GridMap(room().cells, 0.1, (10.0, -5.0, yaw))
    (start_x, start_y), (goal_x, goal_y) = grid.metres(np.array([[10, 10], [30, 50]], np.int32))
    plan = plan_path(grid, None, Pose(start_x, start_y), Point(goal_x, goal_y), 0.2)
    assert (plan.cells[0].tolist(), plan.cells[-1].tolist()) == ([10, 10], [30, 50])
    assert plan.metres == pytest.approx(grid.metres(plan.cells), abs=1e-5)
    length = np.hypot(*np.diff(plan.metres.astype(float), axis=0).T).sum()
    assert plan.cost == pytest.approx(length, abs=1e-4)
    assert plan.cost == pytest.approx((20 + 20 * math.sqrt(2)) * 0.1, rel=1e-9)
    assert plan.cells.dtype == np.int32
    assert plan.metres.dtype == np.float32


def test_unknown_is_blocked_and_half_occupied_is_not() -> None:
    """Values 0 to 99 are passable; -1 and 100 are not."""
    for value, status in ((-1, "GOAL_OCCUPIED"), (99, "NONE"), (100, "GOAL_OCCUPIED"), (50, "NONE")):
        cells = room().cells.copy()
        cells[20, 20] = value
        assert plan_path(GridMap(cells, 0.1), None, Pose(1.0, 1.0), Point(2.05, 2.05), 0.0).status == status


@pytest.mark.parametrize("yaw", [0.0, 1.1])
@pytest.mark.parametrize("heading", [0.0, -2.0])
def test_a_scan_blocks_the_disc_around_its_hit(yaw: float, heading: float) -> None:
    """The cell at the end of the beam is blocked, and so are those within the robot's radius of it."""
    grid = GridMap(np.zeros((60, 60), np.int8), 0.1, (1.0, 2.0, yaw))
    hit_cell, radius_cells = np.array([30, 42]), 3.0
    (x, y), (hit_x, hit_y) = grid.metres(np.array([[30, 20], hit_cell], np.int32))
    scan = one_beam(math.hypot(hit_x - x, hit_y - y), math.atan2(hit_y - y, hit_x - x) - heading)
    for cell in np.ndindex(10, 10):
        target = hit_cell - 5 + cell
        goal_x, goal_y = grid.metres(target.astype(np.int32))[0]
        plan = plan_path(grid, scan, Pose(x, y, heading), Point(goal_x, goal_y), 0.3)
        inside = np.hypot(*(target - hit_cell)) <= radius_cells
        assert plan.status == ("GOAL_OCCUPIED" if inside else "NONE"), cell


def test_beams_without_a_hit_block_nothing() -> None:
    """Infinite, NaN and negative ranges, and those from the maximum range on, are no hits."""
    ranges = np.array([np.inf, np.nan, 5.0, 7.0, -1.0], np.float32)
    pose = Pose(2.0, 2.0)
    scan = Scan(ranges, 0.0, 1.0, 5.0)
    assert planner.scan_hits(room(), scan, pose, 0.2).rows.size == 0


def test_a_near_obstacle_does_not_block_the_robots_own_cell() -> None:
    """If an obstacle is nearer than the radius, the robot can still drive away from it."""
    grid = room()
    for angle in np.linspace(0, 2 * math.pi, 24, endpoint=False):
        for distance in (0.01, 0.06, 0.11, 0.2, 0.3):
            pose = Pose(3.05, 2.05)
            scan = one_beam(distance, float(angle))
            back = Point(3.05 - math.cos(angle), 2.05 - math.sin(angle))
            assert plan_path(grid, scan, pose, back, 0.5).status == "NONE", (angle, distance)


def test_costs_weigh_the_path_as_navfn_does() -> None:
    """The path avoids an expensive strip if that is cheaper; the cost is the weighted length in metres."""
    grid = GridMap(np.zeros((21, 21), np.int8), 0.5)
    costs = np.zeros((21, 21), np.uint8)
    costs[8:13, 10] = 252
    around = plan_path(grid, None, Pose(2.75, 5.25), Point(7.75, 5.25), 0.0, costs)
    assert not (costs[tuple(around.cells.T)] > 0).any()
    costs[:, 10] = 50
    through = plan_path(grid, None, Pose(2.75, 5.25), Point(7.75, 5.25), 0.0, costs)
    assert through.cost == pytest.approx((9 + (50 + 0.8 * 50) / 50) * 0.5, rel=1e-9)
    costs[:, 10] = 253
    assert plan_path(grid, None, Pose(2.75, 5.25), Point(7.75, 5.25), 0.0, costs).status == "NO_VALID_PATH"
    costs[10, 15] = 255
    assert plan_path(grid, None, Pose(2.75, 5.25), Point(7.75, 5.25), 0.0, costs).status == "GOAL_OCCUPIED"


def test_costs_may_have_any_memory_layout() -> None:
    """Read-only and column-major costs give the same plan."""
    costs = np.random.default_rng(2).integers(0, 253, (40, 60)).astype(np.uint8)
    frozen = costs.copy()
    frozen.flags.writeable = False
    plans = [
        plan_path(room(), None, Pose(1.0, 1.0), Point(5.0, 3.0), 0.2, given)
        for given in (costs, frozen, np.asfortranarray(costs))
    ]
    assert len({plan.cost for plan in plans}) == 1


GOOD = (room(), one_beam(1.0), Pose(1.0, 1.0), Point(5.0, 3.0), 0.2, None)


@pytest.mark.parametrize(
    ("place", "value", "said"),
    [
        (1, Scan(np.zeros((2, 2), np.float32), 0.0, 0.1, 5.0), "scan.ranges"),
        (1, Scan(np.zeros(4, np.int32), 0.0, 0.1, 5.0), "scan.ranges"),
        (1, Scan(np.zeros(10_001, np.float32), 0.0, 0.1, 5.0), "scan.ranges"),
        (1, Scan(np.zeros(4, np.float32), math.nan, 0.1, 5.0), "scan.angle_min"),
        (1, Scan(np.zeros(4, np.float32), 0.0, 0.1, math.inf), "scan.range_max"),
        (2, Pose(math.nan, 0.0), "pose.x"),
        (2, Pose(0.0, 0.0, math.inf), "pose.yaw"),
        (3, Point(0.0, math.inf), "goal.y"),
        (4, -0.1, "radius_m"),
        (4, 1e9, "radius_m"),
        (5, np.zeros((40, 60)), "costs"),
        (5, np.zeros((60, 40), np.uint8), "costs"),
    ],
)
def test_wrong_arguments_are_named(place: int, value: object, said: str) -> None:
    """A wrong argument is a ValueError that names it, before anything is computed."""
    args = [*GOOD]
    args[place] = value  # type: ignore[call-overload]
    with pytest.raises(ValueError, match=said):
        plan_path(*args)  # type: ignore[arg-type]


def test_the_task_is_registered_with_the_papers_size() -> None:
    """Its input size is the d of the straight line, divided by the cells of the map."""
    kind = kind_of(plan_path)
    assert kind.types == (GridMap, Scan, Pose, Point, Plan)
    args = kind.bind((room(), None, Pose(1.0, 1.0), Point(5.0, 4.0)), {})
    assert kind.size_of(args) == maps.path_size(5.0, 0.1, 2400)
    assert kind.warm is planner.warm


def test_a_map_is_prepared_once_for_each_radius(monkeypatch: pytest.MonkeyPatch) -> None:
    """Grids with the same cells share the prepared map; a grid with other cells gets its own."""
    made: list[float] = []

    def counted(grid: GridMap, radius_m: float) -> NDArray[np.bool_]:
        made.append(radius_m)
        return maps.passable(grid, radius_m)

    monkeypatch.setattr(planner, "passable", counted)
    cells = room().cells
    for _ in range(3):
        for radius in (0.2, 0.3):
            plan_path(GridMap(cells, 0.1), None, Pose(1.0, 1.0), Point(5.0, 3.0), radius)
    assert made == [0.2, 0.3]
    plan_path(room(), None, Pose(1.0, 1.0), Point(5.0, 3.0), 0.2)
    assert made == [0.2, 0.3, 0.2]


def test_prepared_maps_are_bounded_and_die_with_their_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    """At most PREPARED_MAX maps are kept, and none whose cells are gone."""
    alive: weakref.WeakSet[search.Field] = weakref.WeakSet()

    class Watched(search.Field):
        def __init__(self, passable: NDArray[np.bool_]) -> None:
            super().__init__(passable)
            alive.add(self)

    monkeypatch.setattr(search, "Field", Watched)
    grids = [room() for _ in range(planner.PREPARED_MAX + 3)]
    for grid in grids:
        plan_path(grid, None, Pose(1.0, 1.0), Point(5.0, 3.0), 0.2)
    gc.collect()
    assert len(alive) == planner.PREPARED_MAX
    del grids, grid
    gc.collect()
    last = room()
    plan_path(last, None, Pose(1.0, 1.0), Point(5.0, 3.0), 0.2)
    gc.collect()
    assert len(alive) == 1


def test_two_threads_plan_on_one_map() -> None:
    """Both get the plans that one thread gets alone, also for the first request on a map."""
    willow = read_map(ROOT / "maps/willow-full-0.05.yaml")
    pairs = willow.metres(maps.free_pairs(willow, 12, seed=3, radius_m=0.2).reshape(-1, 2)).reshape(-1, 2, 2)

    def answers(grid: GridMap) -> list[tuple[str, float, list[list[int]]]]:
        plans = []
        for n, ((x, y), (goal_x, goal_y)) in enumerate(pairs.tolist()):
            scan = Scan(np.full(90, 0.5 + 0.2 * n, np.float32), 0.0, math.pi / 45, 10.0)
            plans.append(plan_path(grid, scan if n % 3 else None, Pose(x, y), Point(goal_x, goal_y), 0.2))
        return [(plan.status, plan.cost, plan.cells.tolist()) for plan in plans]

    alone = answers(willow)
    fresh = GridMap(willow.cells.copy(), willow.resolution, willow.origin)
    together: list[object] = []
    threads = [threading.Thread(target=lambda: together.append(answers(fresh))) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert together == [alone, alone]
    assert {status for status, *_ in alone} >= {"NONE"}


def test_without_numba_planning_names_the_extra() -> None:
    """The module can be imported, and the first plan raises an error that names the extra."""
    code = (
        "import sys; sys.modules['numba'] = None\n"
        "import numpy as np\n"
        "from offboard.common.errors import MissingExtra\n"
        "from offboard.common.planning.planner import *\n"
        "try: plan_path(GridMap(np.zeros((4, 4), np.int8), 1.0), None, Pose(1, 1), Point(2, 2))\n"
        "except MissingExtra as error: print(error)\n"
    )
    ran = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == needs("planning", "planning")


def test_scan_hits_are_in_cells() -> None:
    """The reach of a hit is the radius in cells, but ends one cell before the robot."""
    hits = planner.scan_hits(
        room(), Scan(np.array([0.3, 3.0], np.float32), 0.0, 0.0, 5.0), Pose(1.05, 1.05), 0.5
    )
    assert isinstance(hits, search.Hits)
    assert hits.cols.tolist() == [13, 40]
    assert hits.reach.tolist() == pytest.approx([2.0, 5.0])
