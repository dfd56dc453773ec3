"""What the planner server knows: maps with updates, costs of nav2, scans that grow old."""

import numpy as np
import pytest

from offboard.common.planning.maps import GridMap
from offboard.common.planning.planner import Point, Pose, Scan, plan_path
from offboard.ros2.world import COST_MAX, COSTS, View, World, nearest_free


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def grid(*rows: str) -> GridMap:
    values = {"#": 100, ".": 0, "?": -1}
    return GridMap(np.array([[values[cell] for cell in row] for row in rows], np.int8), 1.0)


def test_there_is_no_view_before_the_first_map() -> None:
    """A pose alone is no world to plan in, and an update needs a map."""
    world = World(allow_unknown=True)
    world.see_pose(Pose(1, 1))
    assert world.view() is None
    assert not world.update_map(0, 0, np.zeros((1, 1), np.int8))


@pytest.mark.parametrize("allowed", [True, False])
def test_unknown_cells_are_free_only_if_allowed(allowed: bool) -> None:
    """`allow_unknown` decides whether a path may cross what nobody has seen."""
    world = World(allow_unknown=allowed)
    world.see_map(grid("..?..", "##?##", "..?.."))
    view = world.view()
    assert view is not None
    plan = plan_path(view.grid, None, Pose(0.5, 0.5), Point(4.5, 2.5), 0.0)
    assert plan.status == ("NONE" if allowed else "NO_VALID_PATH")


def test_an_update_changes_its_cells_and_not_the_view_that_was_taken_before() -> None:
    """A plan that is under way keeps its map; the next one gets the new cells."""
    world = World(allow_unknown=True)
    world.see_map(grid("...", "...", "..."))
    before = world.view()
    assert world.update_map(1, 2, np.full((1, 2), 100, np.int8))
    after = world.view()
    assert before is not None
    assert after is not None
    assert before.grid.cells.max() == 0
    assert np.argwhere(after.grid.cells == 100).tolist() == [[2, 1], [2, 2]]
    assert not world.update_map(2, 2, np.zeros((1, 2), np.int8))  # past the edge
    assert not world.update_map(-1, 0, np.zeros((1, 2), np.int8))


def test_costs_of_nav2_come_back() -> None:
    """nav2 publishes costs 1 to 252 as 1 to 98; each value stands for the lowest cost that has it."""
    published = {0: 0, 253: 99, 254: 100} | {cost: 1 + 97 * (cost - 1) // 251 for cost in range(1, 253)}
    for cost in (0, 1, 100, 252, 253, 254):
        found = int(COSTS[published[cost]])
        assert published[found] == published[cost]
        assert found <= cost
    assert COSTS[np.int8(-1).view(np.uint8)] == 255


def test_a_costmap_is_planned_with_its_costs() -> None:
    """In a costmap, inscribed cells block, cheap cells are preferred, and only the costs change."""
    world = World(allow_unknown=True, costmap=True)
    cells = np.zeros((3, 5), np.int8)
    cells[1, 2], cells[0, 2], cells[2, 2] = 99, 60, -1
    world.see_map(GridMap(cells, 1.0))
    view = world.view()
    assert view is not None
    assert view.costs is not None
    assert view.costs[2, 2] == COST_MAX
    plan = plan_path(view.grid, None, Pose(0.5, 1.5), Point(4.5, 1.5), 0.0, view.costs)
    assert [0, 2] in plan.cells.tolist()
    world.update_map(2, 0, np.full((1, 1), 100, np.int8))
    after = world.view()
    assert after is not None
    assert after.costs is not None
    assert after.grid is view.grid
    assert after.costs[0, 2] == 254


def test_a_scan_is_forgotten_after_a_second() -> None:
    """An old scan no longer says where people stand."""
    clock = Clock()
    world = World(allow_unknown=True, now_s=clock)
    world.see_map(grid("..."))
    scan = Scan(np.ones(4, np.float32), 0.0, 1.0, 5.0)
    world.see_scan(scan)
    for now_s, seen in ((0.9, scan), (1.1, None)):
        clock.now = now_s
        view = world.view()
        assert view is not None
        assert view.scan is seen


def test_the_nearest_free_cell_is_found_within_the_tolerance() -> None:
    """An occupied goal moves to the nearest cell where the robot may stand, if there is one near enough."""
    view = View(grid(".....", ".###.", ".###.", ".###.", "....."))
    assert nearest_free(view, Point(2.5, 1.4), radius_m=0.0, tolerance_m=2.0) == Point(2.5, 0.5)
    assert nearest_free(view, Point(2.5, 2.5), radius_m=0.0, tolerance_m=1.9) is None
    assert nearest_free(view, Point(2.5, 2.5), radius_m=1.0, tolerance_m=2.1) is None  # too tight everywhere
    assert nearest_free(view, Point(9.5, 2.5), radius_m=0.0, tolerance_m=2.0) is None
    assert nearest_free(view, Point(2.5, 2.5), radius_m=0.0, tolerance_m=0.0) is None


def test_the_nearest_free_cell_is_free_of_scan_and_costs() -> None:
    """What the scan sees, and what costs block, is no place for a goal."""
    free = grid(".......", ".......", ".......")
    costs = np.zeros((3, 7), np.uint8)
    costs[:, 3] = 253
    near = nearest_free(View(free, costs=costs), Point(3.5, 1.5), radius_m=0.0, tolerance_m=1.5)
    assert near in (Point(2.5, 1.5), Point(4.5, 1.5))
    scan = Scan(np.array([4.0], np.float32), 0.0, 1.0, 10.0)
    seen = View(free, costs=costs, pose=Pose(0.5, 1.5), scan=scan)
    assert nearest_free(seen, Point(3.5, 1.5), radius_m=0.0, tolerance_m=1.0) == Point(2.5, 1.5)
