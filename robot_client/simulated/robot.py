"""A simulated robot: stands on a map with obstacles that its prior map lacks, asks for paths, drives them.

Where its paths are planned is the business of the `Offloader`.
"""

import math

import numpy as np
from numpy.typing import NDArray

from offboard.common.errors import ConfigError
from offboard.common.planning.grid_kernels import covered
from offboard.common.planning.maps import OCCUPIED, GridMap, largest_component, passable, path_size
from offboard.common.planning.planner import RADIUS_CELLS_MAX, RADIUS_M, Plan, Point, Pose, Scan, scan_hits
from offboard.common.planning.planner_names import DIJKSTRA
from offboard.robot_client.simulated.lidar import BEAMS, RANGE_MAX_M, cast_scan

OBSTACLE_SIDE_M = (0.3, 1.0)
LOOK_EVERY_M = 0.5
TRIES_MAX = 5  # plans for one goal before another is picked
FAILURES_MAX = 3  # goals in a row without a path before the robot is set down elsewhere
CANDIDATES = 32  # random cells of which the next goal is one

Request = tuple[GridMap, Scan, Pose, Point, float, None, str]


class SimulatedRobot:
    """A robot of `radius_m` on `prior`, in a world with `obstacles` boxes more; all random by `seed`.

    `truth` is that world; `stops` counts the paths that it could not drive to their end. Wherever a `size`
    is taken, it is the input size d that the next goal shall have as nearly as the candidates allow.
    """

    def __init__(
        self,
        prior: GridMap,
        *,
        seed: int,
        obstacles: int = 40,
        radius_m: float = RADIUS_M,
        beams: int = BEAMS,
        range_max: float = RANGE_MAX_M,
        size: float | None = None,
        planner: str = DIJKSTRA,
    ) -> None:
        if radius_m > RADIUS_CELLS_MAX * prior.resolution:
            allowed = f"at most {RADIUS_CELLS_MAX} cells of {prior.resolution:g} m"
            raise ConfigError(f"a radius of {radius_m:g} m is not allowed, {allowed}")
        self.prior, self.radius_m, self._planner = prior, radius_m, planner
        self._beams, self._range_max = beams, range_max
        self._random = np.random.default_rng(seed)
        self.truth = _with_boxes(prior, self._free(prior), obstacles, self._random)
        self._standable = self._free(self.truth)
        self.pose, self.goal = Pose(0.0, 0.0), Point(0.0, 0.0)
        self.stops = 0
        self._failures = 0
        self._set_down()
        self._pick_goal(size)

    def request(self) -> Request:
        """The arguments of `plan_path`, from where the robot stands; asking twice changes nothing."""
        return self.prior, self._scan(), self.pose, self.goal, self.radius_m, None, self._planner

    def drive(self, plan: Plan, size: float | None = None) -> NDArray[np.int32]:
        """Follow the plan, looking again every half metre; stop before what was not there when it was made.

        Returns the cells (row, col) it drove, K x 2.
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
        """Stand at the goal, turned at random, and pick the next one: nothing of it depends on an answer."""
        self.pose = Pose(self.goal.x, self.goal.y, float(self._random.uniform(-math.pi, math.pi)))
        self._pick_goal(size)

    def give_up_goal(self, size: float | None = None) -> None:
        """There is no path to the goal: pick another one, from another place if that went on for long."""
        self._failures += 1
        if self._failures == FAILURES_MAX:
            self._set_down()
        self._pick_goal(size)

    def _follow(self, cells: NDArray[np.int32]) -> NDArray[np.int32]:
        """Drive cell by cell; those before the first that is not safe."""
        stride = max(1, round(LOOK_EVERY_M / self.prior.resolution))
        for first in range(0, len(cells), stride):
            stretch = cells[first : first + stride]
            safe = self._safe_length(stretch)
            self._move(stretch[:safe])
            if safe < len(stretch):
                return cells[: first + safe]
        return cells

    def _safe_length(self, stretch: NDArray[np.int32]) -> int:
        """How many of the next cells are clear of all that a scan from here sees.

        It does not see round a corner: the bumper stops before a cell that is truly occupied.
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
        return cast_scan(self.truth, self.pose, beams=self._beams, range_max=self._range_max)

    def _free(self, grid: GridMap) -> NDArray[np.int32]:
        # Row after row: from any other order a draw of a few cells copies them all first.
        free = np.argwhere(largest_component(passable(grid, self.radius_m))).astype(np.int32, order="C")
        if len(free) < 2:
            raise ConfigError(f"the map has no room for a robot of radius {self.radius_m} m")
        return free

    def _set_down(self) -> None:
        x, y = self.prior.metres(self._random.choice(self._standable)[None])[0]
        self.pose = Pose(float(x), float(y), float(self._random.uniform(-math.pi, math.pi)))
        self._failures = 0

    def _pick_goal(self, size: float | None) -> None:
        """Of some random cells the one nearest to `size`; without, to a distance drawn evenly."""
        points = self.prior.metres(self._random.choice(self._standable, CANDIDATES))
        distances = np.hypot(*(points - (self.pose.x, self.pose.y)).T)
        if size is None:
            away = np.abs(distances - self._random.uniform(0, distances.max()))
        else:
            away = np.abs([self._size(distance) - size for distance in distances])
        x, y = points[away.argmin()]
        self.goal = Point(float(x), float(y))
        self._tries = 0

    def _size(self, distance_m: float) -> float:
        return path_size(distance_m, self.prior.resolution, self.prior.cells.size)


def _with_boxes(prior: GridMap, free: NDArray[np.int32], count: int, random: np.random.Generator) -> GridMap:
    """The map with `count` occupied boxes centred on free cells."""
    cells = prior.cells.copy()
    for row, col in random.choice(free, count):
        high, wide = np.ceil(random.uniform(*OBSTACLE_SIDE_M, 2) / prior.resolution).astype(int)
        top, left = max(row - high // 2, 0), max(col - wide // 2, 0)
        cells[top : top + high, left : left + wide] = OCCUPIED
    return GridMap(cells, prior.resolution, prior.origin)
