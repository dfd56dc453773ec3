"""The task `plan_path`: the exact shortest path of a robot on its map, with the obstacles of its scan added.

This file decides which cells are blocked, and keeps prepared maps. The search itself is in `search`.
"""

import math
import threading
import weakref
from collections import OrderedDict
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.common.planning import DIJKSTRA, check_planner, search
from offboard.common.planning.maps import CELLS_MAX, GridMap, in_cells, passable, path_size
from offboard.common.tasks import task

RADIUS_M = 0.2
PREPARED_MAX = 4  # prepared maps that are kept; each takes 9 bytes per cell with one search at a time
PREPARED_CELLS_MAX = CELLS_MAX  # cells of all prepared maps together, except for the one in use
BEAMS_MAX = 10_000
RADIUS_CELLS_MAX = 200  # with BEAMS_MAX beams, adding the scan still takes only seconds
BEHIND_CELLS = 0.001  # a beam ends on the surface between two cells; the occupied one is this much farther


@dataclass(frozen=True, slots=True)
class Pose:
    """The pose of the robot in the map frame, in m and rad."""

    x: float
    y: float
    yaw: float = 0.0


@dataclass(frozen=True, slots=True)
class Point:
    """A place in the map frame, in m."""

    x: float
    y: float


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """A LiDAR scan in the robot's frame. A beam hit something if its range is below `range_max` (in m)."""

    ranges: NDArray[np.float32]
    angle_min: float
    angle_increment: float
    range_max: float


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """A path, or the reason why there is none: `status` is NONE or an error of nav2's ComputePathToPose.

    `cells` are (row, column) from start to goal, and `metres` their centres in the map frame. `cost` is the
    length in metres; with costs, each metre is multiplied by the factor of its cell. `expanded` is the number
    of cells that the search settled, or of its jump points.
    """

    status: str
    cells: NDArray[np.int32]
    metres: NDArray[np.float32]
    cost: float
    expanded: int


def size_of_plan(
    grid: GridMap, _scan: Scan | None, pose: Pose, goal: Point, *_options: Any, **_named: Any
) -> float:
    """The paper's input size d for the straight line from pose to goal."""
    return path_size(math.hypot(goal.x - pose.x, goal.y - pose.y), grid.resolution, grid.cells.size)


def warm() -> None:
    """Compile all kernels that a request needs, or load them from the cache.

    A* and jump point search are compiled at their first request: they would take longer than all the rest.
    """
    grid = GridMap(np.zeros((8, 8), np.int8), 1.0)
    scan = Scan(np.full(4, 2.5, np.float32), 0.0, math.pi / 2, 10.0)
    for costs in (None, np.zeros((8, 8), np.uint8)):
        plan_path(grid, scan, Pose(4.5, 4.5), Point(0.5, 0.5), radius_m=1.0, costs=costs)


def work_of_plan(plan: Plan) -> float:
    """The number of cells that the search settled, or of its jump points."""
    return plan.expanded


@task("plan_path", size=size_of_plan, types=(GridMap, Scan, Pose, Point, Plan), warm=warm, work=work_of_plan)
def plan_path(
    grid: GridMap,
    scan: Scan | None,
    pose: Pose,
    goal: Point,
    radius_m: float = RADIUS_M,
    costs: NDArray[np.uint8] | None = None,
    planner: str = DIJKSTRA,
) -> Plan:
    """Plan for a robot of this radius; without `scan` on the prior map alone.

    `costs`, of the map's shape, weighs entering a cell as NavFn does, (50 + 0.8 c) / 50; 253 to 255 block.
    All planners find the same cost: `dijkstra`, `astar`, or `jps`, which takes no `costs`.
    """
    check_planner(planner, weighted=costs is not None)
    _check(grid, scan, pose, goal, radius_m=radius_m, costs=costs)
    start, end = grid.cell(pose.x, pose.y), grid.cell(goal.x, goal.y)
    if start is None:
        return _plan(grid, search.no_route("START_OUTSIDE_MAP"))
    if end is None:
        return _plan(grid, search.no_route("GOAL_OUTSIDE_MAP"))
    hits = search.NO_HITS if scan is None else scan_hits(grid, scan, pose, radius_m)
    return _plan(grid, _prepared(grid, radius_m).route(start, end, hits=hits, costs=costs, planner=planner))


def scan_hits(grid: GridMap, scan: Scan, pose: Pose, radius_m: float) -> search.Hits:
    """The cells that the scan saw occupied, and how far around each (in cells) the robot cannot be.

    This reach ends one cell before the robot, so that the robot's own cell is never blocked.
    """
    ranges = np.asarray(scan.ranges, np.float64)
    beams = np.flatnonzero(np.isfinite(ranges) & (ranges >= 0) & (ranges < scan.range_max))
    row, col = grid.position(pose.x, pose.y)
    angles = pose.yaw - grid.origin[2] + scan.angle_min + scan.angle_increment * beams
    lengths = ranges[beams] / grid.resolution + BEHIND_CELLS
    rows = np.floor(row + lengths * np.sin(angles)).astype(np.int64)
    cols = np.floor(col + lengths * np.cos(angles)).astype(np.int64)
    distances = np.hypot(rows - math.floor(row), cols - math.floor(col))
    reach = np.minimum(in_cells(grid, radius_m), distances - 1)
    seen = reach >= 0
    return search.Hits(rows[seen], cols[seen], reach[seen])


def _plan(grid: GridMap, route: search.Route) -> Plan:
    metres = grid.metres(route.cells).astype(np.float32)
    cost = route.cost * grid.resolution
    return Plan(route.status, route.cells, metres, cost=cost, expanded=route.expanded)


_fields: "OrderedDict[tuple[int, float], tuple[weakref.ref[NDArray[np.int8]], search.Field]]" = OrderedDict()
_lock = threading.Lock()


def _prepared(grid: GridMap, radius_m: float) -> search.Field:
    """The map inflated by the radius, ready to search. It is kept by the identity of the map's cells.

    The lock is held while a map is prepared, so that two requests do not prepare the same map.
    """
    key = (id(grid.cells), radius_m / grid.resolution)
    with _lock:
        for old in [name for name, (cells, _) in _fields.items() if cells() is None]:
            del _fields[old]  # another array may have the same id by now
        if key not in _fields:
            _fields[key] = (weakref.ref(grid.cells), search.Field(passable(grid, radius_m)))
        _fields.move_to_end(key)
        while len(_fields) > 1 and (
            len(_fields) > PREPARED_MAX
            or sum(field.size for _, field in _fields.values()) > PREPARED_CELLS_MAX
        ):
            _fields.popitem(last=False)
        return _fields[key][1]


def _check(
    grid: GridMap,
    scan: Scan | None,
    pose: Pose,
    goal: Point,
    *,
    radius_m: float,
    costs: NDArray[np.uint8] | None,
) -> None:
    """ValueError names the wrong argument, its value, and what is allowed."""
    grid.check()
    for name, value in (("pose.x", pose.x), ("pose.y", pose.y), ("pose.yaw", pose.yaw), ("goal.x", goal.x),
                        ("goal.y", goal.y), ("radius_m", radius_m)):  # fmt: skip
        if not math.isfinite(value):
            raise ValueError(f"{name} is {value}; it must be a finite number")
    if not 0 <= radius_m <= RADIUS_CELLS_MAX * grid.resolution:
        raise ValueError(f"radius_m is {radius_m}; allowed are 0 to {RADIUS_CELLS_MAX} cells")
    if scan is not None:
        _check_scan(scan)
    if costs is not None and (costs.dtype != np.uint8 or costs.shape != grid.cells.shape):
        raise ValueError(f"costs are {costs.dtype} {costs.shape}; they must be uint8 {grid.cells.shape}")


def _check_scan(scan: Scan) -> None:
    ranges = scan.ranges
    if ranges.ndim != 1 or ranges.dtype.kind != "f" or ranges.size > BEAMS_MAX:
        raise ValueError(
            f"scan.ranges is {ranges.dtype} {ranges.shape}; it must be one row of at most {BEAMS_MAX} floats"
        )
    for name in ("angle_min", "angle_increment", "range_max"):
        if not math.isfinite(getattr(scan, name)):
            raise ValueError(f"scan.{name} is {getattr(scan, name)}; it must be a finite number")
