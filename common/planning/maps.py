"""Occupancy grids: cells and metres, passable cells, the paper's input size, and finer grids."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from offboard.common.errors import DataError
from offboard.common.planning.grid_kernels import inflate, largest_component

UNKNOWN, FREE, OCCUPIED = -1, 0, 100
CELLS_MAX = 2**26  # 67 million: 410 m x 410 m at 0.05 m


@dataclass(frozen=True, eq=False)
class GridMap:
    """An occupancy grid with the values of ROS: -1 unknown, 0 free to 100 occupied. Row 0 has the lowest y.

    `resolution` is in metres per cell. `origin` is the pose (x, y in m, yaw in rad) of the corner of cell
    (0, 0). Nothing can change `cells`: its identity names the map as long as the process lives.
    """

    cells: NDArray[np.int8]
    resolution: float
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        self.check()
        cells = self.cells
        of_a_map = isinstance(getattr(cells.base, "base", None), bytes) and cells.flags.c_contiguous
        if not of_a_map:  # a read-only array may be unlocked, or have a view that is not read-only
            cells = np.frombuffer(cells.tobytes(), np.int8).reshape(cells.shape)
            object.__setattr__(self, "cells", cells)
        x, y, yaw = self.origin
        object.__setattr__(self, "origin", (float(x), float(y), float(yaw)))

    def check(self) -> None:
        """ValueError names a wrong field. A map from a message was made without this check."""
        cells = self.cells
        if not isinstance(cells, np.ndarray) or cells.dtype != np.int8 or cells.ndim != 2:
            raise ValueError("grid.cells must be an int8 array of two dimensions")
        if not 0 < cells.size <= CELLS_MAX:
            raise ValueError(f"grid.cells has {cells.size} cells; allowed are 1 to {CELLS_MAX}")
        if not (math.isfinite(self.resolution) and self.resolution > 0):
            raise ValueError(f"grid.resolution is {self.resolution}; it must be a number above 0")
        if len(self.origin) != 3 or not all(map(math.isfinite, self.origin)):
            raise ValueError(f"grid.origin is {self.origin}; it must be three finite numbers x, y, yaw")

    def position(self, x: float, y: float) -> tuple[float, float]:
        """A point of the map frame as fractional (row, column); cell (r, c) begins at (r, c)."""
        dx, dy, yaw = x - self.origin[0], y - self.origin[1], self.origin[2]
        along = dx * math.cos(yaw) + dy * math.sin(yaw)
        across = dy * math.cos(yaw) - dx * math.sin(yaw)
        return across / self.resolution, along / self.resolution

    def cell(self, x: float, y: float) -> tuple[int, int] | None:
        """The (row, column) of the cell that contains a point of the map frame; None outside the map."""
        row, col = (math.floor(value) for value in self.position(x, y))
        inside = 0 <= row < self.cells.shape[0] and 0 <= col < self.cells.shape[1]
        return (row, col) if inside else None

    def metres(self, cells: NDArray[np.int32]) -> NDArray[np.float64]:
        """The centres of cells (row, column) as (x, y) in the map frame."""
        across, along = ((cells + 0.5) * self.resolution).reshape(-1, 2).T
        x, y, yaw = self.origin
        cos, sin = math.cos(yaw), math.sin(yaw)
        return np.stack((x + along * cos - across * sin, y + along * sin + across * cos), axis=1)


def path_size(distance_m: float, resolution: float, map_cells: int = 1) -> float:
    """The paper's input size d: n ln n with n = 0.5 |AB|^2 / g^2, divided by the cells of the map."""
    n = 0.5 * distance_m**2 / resolution**2
    return n * math.log(n) / map_cells if n > 1 else 0.0


def passable(grid: GridMap, radius_m: float = 0.0) -> NDArray[np.bool_]:
    """Cells where the centre of a robot of this radius may be: known, and clear of occupied cells.

    Unknown cells are blocked but not inflated, as in nav2's default costmap.
    """
    known = grid.cells >= FREE
    if radius_m <= 0:
        return known & (grid.cells < OCCUPIED)
    return known & ~inflate(grid.cells >= OCCUPIED, in_cells(grid, radius_m))


def in_cells(grid: GridMap, radius_m: float) -> float:
    """The radius in cells. The small addition keeps 3 cells at 3: in floats, 0.3 / 0.1 is below 3."""
    return radius_m / grid.resolution + 1e-6


def free_pairs(grid: GridMap, count: int, seed: int, radius_m: float = 0.0) -> NDArray[np.int32]:
    """`count` random pairs of start and goal with a path between them, as (count, 2, 2) of (row, column)."""
    free = np.argwhere(largest_component(passable(grid, radius_m))).astype(np.int32)
    if not len(free):
        raise DataError("the map has no free cell for a start and a goal")
    return free[np.random.default_rng(seed).integers(len(free), size=(count, 2))]


def resampled(grid: GridMap, resolution: float) -> GridMap:
    """The same map with smaller cells. The map's resolution must be a whole multiple of the new one."""
    ratio = grid.resolution / resolution if resolution > 0 else 0.0
    factor = round(ratio)
    if factor < 1 or abs(ratio - factor) > 1e-6 * ratio:
        raise DataError(
            f"resolution {resolution} m: the map's own {grid.resolution} m is not a whole multiple of it"
        )
    if grid.cells.size * factor**2 > CELLS_MAX:
        raise DataError(f"resolution {resolution} m: the map would have more than {CELLS_MAX} cells")
    if factor == 1:
        return grid
    return GridMap(grid.cells.repeat(factor, axis=0).repeat(factor, axis=1), resolution, grid.origin)
