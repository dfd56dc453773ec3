"""What the robot knows of the world: its map with updates, its pose, and its last scan.

What messages look like is `converters`; what a plan needs of this is `planner_server`.
"""

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from offboard.common.planning.maps import FREE, UNKNOWN, GridMap, in_cells, passable
from offboard.common.planning.planner import Point, Pose, Scan, scan_hits
from offboard.common.planning.workspaces import Hits

SCAN_AGE_MAX_S = 1.0  # an older scan no longer says where obstacles are
# nav2 publishes the costs of its costmap as 0 to 100: 1 to 98 for costs 1 to 252, then inscribed and lethal.
INSCRIBED, LETHAL, NO_INFORMATION = 253, 254, 255
COST_MAX = 252  # of a cell where the robot may be
BLOCKED = INSCRIBED
VALUE_INSCRIBED, VALUE_LETHAL = 99, 100


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """One moment of the world. `costs` are those of nav2's costmap, if the map is one."""

    grid: GridMap
    costs: NDArray[np.uint8] | None = None
    pose: Pose | None = None
    scan: Scan | None = None


class World:
    """Keeps the newest of everything. Any thread may call any method.

    allow_unknown: plans may lead through cells that nobody has seen.
    costmap: the map is nav2's costmap, whose values are costs.
    """

    def __init__(
        self, *, allow_unknown: bool, costmap: bool = False, now_s: Callable[[], float] = time.monotonic
    ) -> None:
        self._allow_unknown = allow_unknown
        self._costmap = costmap
        self._now_s = now_s
        self._lock = threading.Lock()
        self._view: View | None = None
        self._pose: Pose | None = None
        self._scan: tuple[Scan, float] | None = None

    def see_map(self, grid: GridMap) -> None:
        """A new map, as it was published."""
        with self._lock:
            self._view = self._read(grid)

    def update_map(self, x: int, y: int, patch: NDArray[np.int8]) -> bool:
        """New values of the cells from column `x` and row `y` on.

        False if there is no map, or if some lie outside of it: then nothing changes.
        """
        with self._lock:
            if self._view is None:
                return False
            height, width = self._view.grid.cells.shape
            if not (0 <= x <= width - patch.shape[1] and 0 <= y <= height - patch.shape[0]):
                return False
            self._view = self._patched(
                self._view, slice(y, y + patch.shape[0]), slice(x, x + patch.shape[1]), patch
            )
            return True

    def see_pose(self, pose: Pose) -> None:
        """Where the robot is in the frame of the map."""
        self._pose = pose

    def see_scan(self, scan: Scan) -> None:
        """A scan in the frame of the robot."""
        self._scan = scan, self._now_s()

    def view(self) -> View | None:
        """The world now; None before the first map. A scan is left out when it is old."""
        if self._view is None:
            return None
        scan = self._scan
        fresh = scan is not None and self._now_s() - scan[1] <= SCAN_AGE_MAX_S
        return replace(self._view, pose=self._pose, scan=scan[0] if scan is not None and fresh else None)

    def _read(self, grid: GridMap) -> View:
        if not self._costmap:
            return View(GridMap(self._known(grid.cells), grid.resolution, grid.origin))
        # All cells are free, so that only the costs change from map to map.
        free = np.zeros_like(grid.cells)
        return View(GridMap(free, grid.resolution, grid.origin), self._costs(grid.cells))

    def _patched(self, view: View, rows: slice, cols: slice, patch: NDArray[np.int8]) -> View:
        if view.costs is not None:
            costs = view.costs.copy()
            costs[rows, cols] = self._costs(patch)
            costs.flags.writeable = False
            return replace(view, costs=costs)
        cells = view.grid.cells.copy()
        cells[rows, cols] = self._known(patch)
        return replace(view, grid=GridMap(cells, view.grid.resolution, view.grid.origin))

    def _known(self, cells: NDArray[np.int8]) -> NDArray[np.int8]:
        return np.where(cells == UNKNOWN, np.int8(FREE), cells) if self._allow_unknown else cells

    def _costs(self, values: NDArray[np.int8]) -> NDArray[np.uint8]:
        """The costs of values that nav2 published; an unknown cell is the dearest one, or blocked."""
        costs = COSTS[values.view(np.uint8)]
        if self._allow_unknown:
            costs[values == UNKNOWN] = COST_MAX
        costs.flags.writeable = False
        return costs


def nearest_free(view: View, goal: Point, *, radius_m: float, tolerance_m: float) -> Point | None:
    """The centre of the nearest cell to `goal`, within the tolerance, where the robot may stand."""
    grid, cell = view.grid, view.grid.cell(goal.x, goal.y)
    if cell is None or tolerance_m <= 0:
        return None
    margin = math.ceil(in_cells(grid, tolerance_m + radius_m)) + 1
    row, col = (max(0, place - margin) for place in cell)
    window = slice(row, cell[0] + margin + 1), slice(col, cell[1] + margin + 1)
    free = passable(GridMap(grid.cells[window], grid.resolution), radius_m)
    if view.costs is not None:
        free &= view.costs[window] < BLOCKED
    if view.scan is not None and view.pose is not None:
        _block(free, scan_hits(grid, view.scan, view.pose, radius_m), row, col)
    cells = np.argwhere(free).astype(np.int32) + np.array((row, col), np.int32)
    places = grid.metres(cells)
    distances = np.hypot(places[:, 0] - goal.x, places[:, 1] - goal.y)
    if not len(distances) or distances.min() > tolerance_m:
        return None
    x, y = places[distances.argmin()]
    return Point(float(x), float(y))


def _block(free: NDArray[np.bool_], hits: Hits, row: int, col: int) -> None:
    """Block the discs of the hits in a window that begins at (row, col)."""
    rows, cols = np.ogrid[row : row + free.shape[0], col : col + free.shape[1]]
    for at_row, at_col, reach in zip(hits.rows, hits.cols, hits.reach, strict=True):
        free &= np.hypot(rows - at_row, cols - at_col) > reach


def _cost_table() -> NDArray[np.uint8]:
    """The cost of each value of a costmap, by the value as an unsigned byte."""
    costs = np.full(256, NO_INFORMATION, np.uint8)
    values = np.arange(1, VALUE_INSCRIBED)
    costs[0] = 0
    costs[values] = np.ceil((values - 1) * 251 / 97 + 1)  # nav2 rounds 1 + 97 (cost - 1) / 251 down
    costs[VALUE_INSCRIBED], costs[VALUE_LETHAL] = INSCRIBED, LETHAL
    return costs


COSTS = _cost_table()
