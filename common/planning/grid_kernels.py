"""Compiled kernels on whole grids: blocking the discs of hits, inflation, and connected components."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.common.planning.compiled import kernel

BLOCKED_COST = 253


@kernel
def load(distance: NDArray[np.float64], template: NDArray[np.uint32], costs: NDArray[np.uint8]) -> None:
    """Set the distance of each cell to infinity (free) or 0 (blocked by the map or by its cost)."""
    for i in range(distance.size):
        distance[i] = 0.0 if template[i] == 0 or costs[i] >= BLOCKED_COST else np.inf


@kernel
def stamp(
    target: NDArray[Any],
    source: NDArray[Any],
    width: Any,
    rows: NDArray[np.int64],
    cols: NDArray[np.int64],
    reach: NDArray[np.float64],
    blocked: bool,
) -> None:
    """Block the disc around each hit, or set its cells back to their values in `source`."""
    across = np.int64(width)
    height = target.size // across
    for k in range(rows.size):
        row, col, radius = rows[k] + 1, cols[k] + 1, int(reach[k])
        for r in range(max(row - radius, 1), min(row + radius, height - 2) + 1):
            for c in range(max(col - radius, 1), min(col + radius, across - 2) + 1):
                if (r - row) ** 2 + (c - col) ** 2 <= reach[k] * reach[k]:
                    i = np.uint64(r * across + c)
                    target[i] = 0 if blocked else source[i]


@kernel
def covered(
    rows: NDArray[np.int32],
    cols: NDArray[np.int32],
    hit_rows: NDArray[np.int64],
    hit_cols: NDArray[np.int64],
    reach: NDArray[np.float64],
) -> int:
    """Position of the first cell that is inside the disc of a hit; the number of cells if none is."""
    for n in range(rows.size):
        for k in range(hit_rows.size):
            if (rows[n] - hit_rows[k]) ** 2 + (cols[n] - hit_cols[k]) ** 2 <= reach[k] * reach[k]:
                return n
    return rows.size


@kernel
def inflate(obstacles: NDArray[np.bool_], radius: float) -> NDArray[np.bool_]:
    """The cells whose centre is at most `radius` cells from the centre of an obstacle; exact."""
    height, width = obstacles.shape
    limit, far = int(radius), int(radius) + 1
    gap = np.empty((height, width), np.int32)  # to the nearest obstacle in the same row, at most `far`
    for r in range(height):
        near = far
        for c in range(width):
            near = 0 if obstacles[r, c] else min(near + 1, far)
            gap[r, c] = near
        near = far
        for c in range(width - 1, -1, -1):
            near = 0 if obstacles[r, c] else min(near + 1, far)
            gap[r, c] = min(gap[r, c], near)
    result = np.zeros((height, width), np.bool_)
    for r in range(height):
        for over in range(max(r - limit, 0), min(r + limit, height - 1) + 1):
            rest = radius * radius - (over - r) ** 2
            for c in range(width):
                result[r, c] |= gap[over, c] * gap[over, c] <= rest
    return result


@kernel
def largest_component(passable: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The largest 4-connected part. If corners are not cut, it is also the largest 8-connected part."""
    height, width = passable.shape
    free = passable.copy().reshape(-1)
    stack = np.empty(
        free.size, np.uint32
    )  # each cell is pushed once, so the stack is also the list of members
    best, best_size = np.zeros(0, np.uint32), 0
    for seed in range(free.size):
        if not free[seed]:
            continue
        free[seed] = False
        stack[0], done, size = seed, 0, 1
        while done < size:
            i = np.int64(stack[done])
            done += 1
            row, col = i // width, i % width
            for inside, j in (
                (row > 0, i - width),
                (row < height - 1, i + width),
                (col > 0, i - 1),
                (col < width - 1, i + 1),
            ):
                if inside and free[j]:
                    free[j] = False
                    stack[size] = j
                    size += 1
        if size > best_size:
            best, best_size = stack[:size].copy(), size
    result = np.zeros(height * width, np.bool_)
    for k in range(best_size):
        result[best[k]] = True
    return result.reshape(height, width)
