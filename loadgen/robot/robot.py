"""A simulated robot with a LiDAR: asks for paths on its map, and drives them in a world with more obstacles.

Where the paths are planned is decided by the offloader. What a scan means for a plan is decided in `planner`.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.common.errors import ConfigError
from offboard.common.planning import DIJKSTRA
from offboard.common.planning.compiled import kernel
from offboard.common.planning.grid_kernels import covered, largest_component
from offboard.common.planning.maps import OCCUPIED, GridMap, passable, path_size
from offboard.common.planning.planner import RADIUS_CELLS_MAX, RADIUS_M, Plan, Point, Pose, Scan, scan_hits

BEAMS = 360
RANGE_MAX_M = 10.0
OBSTACLE_SIDE_M = (0.3, 1.0)
LOOK_EVERY_M = 0.5
TRIES_MAX = 5  # plans for one goal before another is picked
FAILURES_MAX = 3  # goals in a row without a path before the robot is put elsewhere
CANDIDATES = 32  # random cells from which the next goal is chosen

Request = tuple[GridMap, Scan, Pose, Point, float, None, str]


class SimulatedRobot:
    """A robot on the map `prior`, in a world with `obstacles` more boxes; `seed` decides everything random.

    `truth` is that world. `stops` counts the paths that the robot could not drive to their end. Methods with
    a `size` choose, of the candidates, the next goal whose input size d is nearest to it.
    """

    def __init__(
        self,
        prior: GridMap,
        *,
        seed: int,
        obstacles: int = 40,
        radius_m: float = RADIUS_M,
        range_max: float = RANGE_MAX_M,
        size: float | None = None,
        planner: str = DIJKSTRA,
    ) -> None:
        if radius_m > RADIUS_CELLS_MAX * prior.resolution:
            allowed = f"{RADIUS_CELLS_MAX} cells of {prior.resolution:g} m"
            raise ConfigError(f"--radius: {radius_m:g} m is too large, the maximum is {allowed}")
        self.prior, self.radius_m, self._planner = prior, radius_m, planner
        self._range_max = range_max
        self._random = np.random.default_rng(seed)
        self.truth = _with_boxes(prior, self._free(prior), obstacles, self._random)
        self._standable = self._free(self.truth)
        self.pose, self.goal = Pose(0.0, 0.0), Point(0.0, 0.0)
        self.stops = 0
        self._failures = 0
        self._set_down()
        self._pick_goal(size)

    def request(self) -> Request:
        """The arguments of `plan_path` from the place of the robot; a second call returns the same."""
        return self.prior, self._scan(), self.pose, self.goal, self.radius_m, None, self._planner

    def drive(self, plan: Plan, size: float | None = None) -> NDArray[np.int32]:
        """Follow the plan with a new scan every half metre; stop before obstacles that it did not know.

        Returns the cells (row, col) that the robot drove, K x 2.
        """
        if plan.status != "NONE":
            self.give_up_goal(size)
            return plan.cells
        self._failures = 0
        driven = self._follow(plan.cells)
        reached = len(driven) == len(plan.cells)
        self.stops += not reached
        self._tries += 1
        if reached or self._tries == TRIES_MAX:
            self._pick_goal(size)
        return driven

    def jump(self, size: float | None = None) -> None:
        """Put the robot at its goal, in a random direction, and pick the next goal; needs no answer."""
        self.pose = Pose(self.goal.x, self.goal.y, float(self._random.uniform(-math.pi, math.pi)))
        self._pick_goal(size)

    def give_up_goal(self, size: float | None = None) -> None:
        """Pick another goal, as this one has no path; after FAILURES_MAX of them, another place as well."""
        self._failures += 1
        if self._failures == FAILURES_MAX:
            self._set_down()
        self._pick_goal(size)

    def _follow(self, cells: NDArray[np.int32]) -> NDArray[np.int32]:
        """Drive up to the first cell that is not safe; return the cells driven."""
        stride = max(1, round(LOOK_EVERY_M / self.prior.resolution))
        for first in range(0, len(cells), stride):
            stretch = cells[first : first + stride]
            safe = self._safe_length(stretch)
            self._move(stretch[:safe])
            if safe < len(stretch):
                return cells[: first + safe]
        return cells

    def _safe_length(self, stretch: NDArray[np.int32]) -> int:
        """How many of the next cells are clear of everything that a scan from here sees.

        The scan does not see round corners: there the bumper stops the robot before an occupied cell.
        """
        hits = scan_hits(self.prior, self._scan(), self.pose, self.radius_m)
        seen = covered(stretch[:, 0], stretch[:, 1], hits.rows, hits.cols, hits.reach)
        bumped = np.flatnonzero(self.truth.cells[stretch[:, 0], stretch[:, 1]] >= OCCUPIED)
        return int(min([seen, *bumped[:1]]))

    def _move(self, cells: NDArray[np.int32]) -> None:
        if not len(cells):
            return
        points = self.prior.metres(cells[-2:])
        x, y = points[-1]
        dx, dy = points[-1] - points[0]
        yaw = math.atan2(dy, dx) if len(points) == 2 else self.pose.yaw
        self.pose = Pose(float(x), float(y), yaw)

    def _scan(self) -> Scan:
        return cast_scan(self.truth, self.pose, range_max=self._range_max)

    def _free(self, grid: GridMap) -> NDArray[np.int32]:
        # C order, since drawing a few cells from another order first copies all of them.
        free = np.argwhere(largest_component(passable(grid, self.radius_m))).astype(np.int32, order="C")
        if len(free) < 2:
            problem = f"--radius: the map has no room for a robot of radius {self.radius_m:g} m"
            if grid is not self.prior:
                problem += " among the boxes of --obstacles; --obstacles 0 leaves them out"
            raise ConfigError(problem)
        return free

    def _set_down(self) -> None:
        x, y = self.prior.metres(self._random.choice(self._standable)[None])[0]
        self.pose = Pose(float(x), float(y), float(self._random.uniform(-math.pi, math.pi)))
        self._failures = 0

    def _pick_goal(self, size: float | None) -> None:
        """Of CANDIDATES cells, pick the one nearest to `size`, or without it to a uniform random distance."""
        points = self.prior.metres(self._random.choice(self._standable, CANDIDATES))
        distances = np.hypot(*(points - (self.pose.x, self.pose.y)).T)
        if size is None:
            away = np.abs(distances - self._random.uniform(0, distances.max()))
        else:
            of_map = self.prior.resolution, self.prior.cells.size
            away = np.abs([path_size(distance, *of_map) - size for distance in distances])
        x, y = points[away.argmin()]
        self.goal = Point(float(x), float(y))
        self._tries = 0


def _with_boxes(prior: GridMap, free: NDArray[np.int32], count: int, random: np.random.Generator) -> GridMap:
    """The map with `count` boxes on it, centred on free cells."""
    cells = prior.cells.copy()
    for row, col in random.choice(free, count):
        high, wide = np.ceil(random.uniform(*OBSTACLE_SIDE_M, 2) / prior.resolution).astype(int)
        top, left = max(row - high // 2, 0), max(col - wide // 2, 0)
        cells[top : top + high, left : left + wide] = OCCUPIED
    return GridMap(cells, prior.resolution, prior.origin)


def cast_scan(truth: GridMap, pose: Pose, *, beams: int = BEAMS, range_max: float = RANGE_MAX_M) -> Scan:
    """One turn of beams from `pose`, the first one straight ahead, each up to the first occupied cell.

    Beams pass through unknown cells; a beam that meets nothing on the map returns infinity.
    """
    row, col = truth.position(pose.x, pose.y)
    increment = 2 * math.pi / beams
    angles = pose.yaw - truth.origin[2] + increment * np.arange(beams)
    lengths = cast(truth.cells, row, col, np.sin(angles), np.cos(angles), range_max / truth.resolution)
    return Scan((lengths * truth.resolution).astype(np.float32), 0.0, increment, range_max)


@kernel
def cast(
    cells: NDArray[np.int8],
    row: float,
    col: float,
    to_row: NDArray[np.float64],
    to_col: NDArray[np.float64],
    reach: float,
) -> NDArray[np.float64]:
    """The length of each beam in cells, up to the first occupied cell; visits every cell on the way."""
    lengths = np.full(to_row.size, np.inf)
    height, width = cells.shape
    for k in range(to_row.size):
        r, c = math.floor(row), math.floor(col)
        step_r, next_r, wide_r = _axis(row, to_row[k])
        step_c, next_c, wide_c = _axis(col, to_col[k])
        length = 0.0
        while 0 <= r < height and 0 <= c < width and length < reach:
            if cells[r, c] >= OCCUPIED:
                lengths[k] = length
                break
            if next_r < next_c:
                length, r, next_r = next_r, r + step_r, next_r + wide_r
            else:
                length, c, next_c = next_c, c + step_c, next_c + wide_c
    return lengths


@kernel
def _axis(start: float, direction: float) -> Any:
    """Along one axis: step from cell to cell, length to the first cell border, length between borders."""
    if direction == 0.0:
        return 0, np.inf, np.inf
    border = math.floor(start) + (1 if direction > 0 else 0)
    return (1 if direction > 0 else -1), (border - start) / direction, abs(1.0 / direction)
