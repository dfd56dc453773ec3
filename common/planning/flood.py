"""The compiled kernels of `search`: floods by Dinitz's buckets, path recovery, inflation, components.

They are leaves: none reassigns an array (a reference count for each neighbour otherwise), and indices are
uint64 (no wrap-around code). Together that is worth 3 to 9 times.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.common.planning.compiled import kernel

STRAIGHT = 80_782  # 114243/80782 is sqrt 2 so closely that the optimum stays exact up to 53,166 cells
DIAGONAL = 114_243
DISTANCE_MAX = 2**32 - 1 - 4 * STRAIGHT  # beyond it a move could overflow
WHEEL = 16  # circular buckets of the weighted flood; the dearest move spans 8 (sqrt 2 * 251.6 / 50)
BLOCKED_COST = 253

FOUND, EMPTY, GROW, TOO_FAR, PAUSE = 0, 1, 2, 3, 4
PAUSE_CELLS = 1 << 17  # expanded between two pauses: about 2 ms


@kernel
def flood(
    distance: NDArray[np.uint32],
    buckets: NDArray[np.uint32],
    state: NDArray[np.int64],
    width: Any,
    goal: Any,
    distance_max: Any,
) -> int:
    """Settle cells bucket by bucket until the goal's bucket opens.

    A bucket is one straight move wide, so its cells are final when it opens: only the two after it are
    live. `state` is low bound, expanded cells, lowest and highest cell expanded, row, the three counts;
    after GROW the call is repeated with larger buckets and goes on where it was, and so it is after PAUSE.
    """
    straight, diagonal, one = np.uint64(STRAIGHT), np.uint64(DIAGONAL), np.uint64(1)
    low, row = np.uint64(state[0]), np.uint64(state[4])
    here, after, later = np.uint64(state[5]), np.uint64(state[6]), np.uint64(state[7])
    expanded, lowest, highest = np.uint64(state[1]), np.uint64(state[2]), np.uint64(state[3])
    capacity, pause = np.uint64(buckets.shape[1]), expanded + np.uint64(PAUSE_CELLS)
    outcome = EMPTY
    while True:
        if distance[goal] < low + straight:
            outcome = FOUND
            break
        if here + after + later == 0:
            break
        if low > np.uint64(distance_max):
            outcome = TOO_FAR
            break
        if max(after, later) + np.uint64(8) * here > capacity:
            outcome = GROW
            break
        if expanded >= pause:
            outcome = PAUSE
            break
        row_after, row_later = (row + one) % np.uint64(3), (row + np.uint64(2)) % np.uint64(3)
        end_after, end_later = low + straight + straight, low + straight + straight + straight
        for k in range(here):
            i = np.uint64(buckets[row, k])
            d = np.uint64(distance[i])
            if d < low:
                continue  # settled by an earlier bucket
            expanded += one
            lowest, highest = min(lowest, i), max(highest, i)
            down, up, left, right = i - width, i + width, i - one, i + one
            reached = d + straight
            after += _lower(distance, buckets, down, reached, end_after, row_after, after)
            after += _lower(distance, buckets, up, reached, end_after, row_after, after)
            after += _lower(distance, buckets, left, reached, end_after, row_after, after)
            after += _lower(distance, buckets, right, reached, end_after, row_after, after)
            reached = d + diagonal
            soon = reached < end_after
            target, end = (row_after, end_after) if soon else (row_later, end_later)
            count = after if soon else later
            west, east = distance[left] != 0, distance[right] != 0
            if distance[down] != 0:
                if west:
                    count += _lower(distance, buckets, down - one, reached, end, target, count)
                if east:
                    count += _lower(distance, buckets, down + one, reached, end, target, count)
            if distance[up] != 0:
                if west:
                    count += _lower(distance, buckets, up - one, reached, end, target, count)
                if east:
                    count += _lower(distance, buckets, up + one, reached, end, target, count)
            after, later = (count, later) if soon else (after, count)
        here, after, later = after, later, np.uint64(0)
        row, low = row_after, low + straight
    state[0], state[1], state[2], state[3] = low, expanded, lowest, highest
    state[4], state[5], state[6], state[7] = row, here, after, later
    return outcome


@kernel
def _lower(distance: Any, buckets: Any, j: Any, reached: Any, end: Any, row: Any, count: Any) -> Any:
    """Lower the distance of cell `j`; 1 when it had to be put into the bucket that ends at `end`."""
    old = np.uint64(distance[j])
    if reached >= old:
        return np.uint64(0)
    distance[j] = reached
    if old < end:
        return np.uint64(0)  # it is there already
    buckets[row, count] = j
    return np.uint64(1)


@kernel
def flood_weighted(
    distance: NDArray[np.float64],
    costs: NDArray[np.uint8],
    moves: NDArray[np.float64],
    buckets: NDArray[np.uint32],
    counts: NDArray[np.int64],
    state: NDArray[np.int64],
    offsets: NDArray[np.uint64],
    goal: Any,
) -> int:
    """As `flood`, each move times the entered cell's factor (at least 1, the width of a bucket).

    The buckets are a wheel; `offsets` lead to the
    neighbours: 2 below and above, 2 beside, 4 diagonal; `state` is the open bucket and the expanded cells.
    """
    one, mask = np.uint64(1), np.uint64(WHEEL - 1)
    bucket, expanded = np.uint64(state[0]), np.uint64(state[1])
    pause = expanded + np.uint64(PAUSE_CELLS)
    outcome = EMPTY
    while True:
        low = float(bucket)
        if distance[goal] < low + 1.0:
            outcome = FOUND
            break
        if counts.sum() == 0:
            break
        row = bucket & mask
        here = np.uint64(counts[row])
        if np.uint64(counts.max()) + np.uint64(8) * here > np.uint64(buckets.shape[1]):
            outcome = GROW
            break
        if expanded >= pause:
            outcome = PAUSE
            break
        for k in range(here):
            i = np.uint64(buckets[row, k])
            d = distance[i]
            if d < low:
                continue
            expanded += one
            for n in range(8):
                j = i + offsets[n]
                if n >= 4 and (
                    distance[i + offsets[n // 2 - 2]] == 0 or distance[i + offsets[2 + n % 2]] == 0
                ):
                    continue
                reached = d + moves[n // 4, costs[j]]
                old = distance[j]
                if reached >= old:
                    continue
                distance[j] = reached
                due = np.int64(reached)
                if old >= due + 1:  # else it is in that bucket already
                    turn = np.uint64(due & (WHEEL - 1))
                    buckets[turn, np.uint64(counts[turn])] = j
                    counts[turn] += 1
        counts[row] = 0
        bucket += one
    state[0], state[1] = bucket, expanded
    return outcome


@kernel
def descend(distance: NDArray[np.uint32], path: NDArray[np.uint64], width: Any, start: Any, goal: Any) -> int:
    """Write the path, goal first; returns its length."""
    i, length = goal, 0
    path[0] = i
    while i != start:
        i = _parent(distance, width, i, np.uint64(STRAIGHT), np.uint64(DIAGONAL))
        length += 1
        path[length] = i
    return length + 1


@kernel
def descend_weighted(
    distance: NDArray[np.float64],
    costs: NDArray[np.uint8],
    moves: NDArray[np.float64],
    path: NDArray[np.uint64],
    width: Any,
    start: Any,
    goal: Any,
) -> int:
    """Write the path, goal first; returns its length."""
    i, length = goal, 0
    path[0] = i
    while i != start:
        i = _parent(distance, width, i, moves[0, costs[i]], moves[1, costs[i]])
        length += 1
        path[length] = i
    return length + 1


@kernel
def _parent(distance: Any, width: Any, i: Any, straight: Any, diagonal: Any) -> Any:
    """The neighbour from which cell `i` got its distance: the sum is the very one the search made."""
    one = np.uint64(1)
    down, up, left, right = i - width, i + width, i - one, i + one
    for j in (down, up, left, right):
        if distance[j] != 0 and distance[j] + straight == distance[i]:
            return j
    for side in (left, right):
        for row_over in (down, up):
            j = row_over + side - i
            if distance[side] != 0 and distance[row_over] != 0 and distance[j] != 0:  # noqa: SIM102
                if distance[j] + diagonal == distance[i]:
                    return j
    return i  # not reached: every settled cell but the start has a parent


@kernel
def load(distance: NDArray[np.float64], template: NDArray[np.uint32], costs: NDArray[np.uint8]) -> None:
    """All cells free or blocked, by the map and by their cost."""
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
    """Block the disc around every hit, or give its cells back the value they have in `source`."""
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
    """Position of the first cell inside the disc of a hit, or the number of cells."""
    for n in range(rows.size):
        for k in range(hit_rows.size):
            if (rows[n] - hit_rows[k]) ** 2 + (cols[n] - hit_cols[k]) ** 2 <= reach[k] * reach[k]:
                return n
    return rows.size


@kernel
def inflate(obstacles: NDArray[np.bool_], radius: float) -> NDArray[np.bool_]:
    """Cells whose centre is within `radius` cells of an obstacle's centre; exact."""
    height, width = obstacles.shape
    limit, far = int(radius), int(radius) + 1
    gap = np.empty((height, width), np.int32)  # to the nearest obstacle of the same row, at most `far`
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
    """The biggest 4-connected part, which is also the biggest 8-connected one without corner cutting."""
    height, width = passable.shape
    free = passable.copy().reshape(-1)
    stack = np.empty(free.size, np.uint32)  # every cell is pushed once: the stack doubles as the member list
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
