"""A simulated LiDAR: casts beams through an occupancy grid, up to the surface of the first occupied cell.

Beams pass through unknown cells, and a beam that leaves the map returns infinity. What a scan means for a
plan is decided in `planner`.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.common.planning.compiled import kernel
from offboard.common.planning.maps import OCCUPIED, GridMap
from offboard.common.planning.planner import Pose, Scan

BEAMS = 360
RANGE_MAX_M = 10.0


def cast_scan(truth: GridMap, pose: Pose, *, beams: int = BEAMS, range_max: float = RANGE_MAX_M) -> Scan:
    """One turn of beams from `pose`, the first one straight ahead; infinity if a beam meets nothing."""
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
