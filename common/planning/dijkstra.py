"""The compiled kernels of Dijkstra's algorithm: the search with Dinitz's buckets, and the path afterwards.

They are called by `workspaces`, which owns the arrays. Two rules make them 3 to 9 times faster: no kernel
reassigns an array (numba would count references for each neighbour), and indices are uint64 (numba would add
code for negative indices). For this speed they are longer, and take more arguments, than other functions.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.common.planning.compiled import kernel

STRAIGHT = 80_782  # 114243/80782 is so close to sqrt 2 that paths of up to 53,166 cells are optimal
DIAGONAL = 114_243
DISTANCE_MAX = 2**32 - 1 - 4 * STRAIGHT  # from a larger distance, one more move could overflow
WHEEL = 16  # circular buckets of the weighted search; the most expensive move spans 8 (sqrt 2 * 251.6 / 50)

# Why a kernel returned: goal reached, no cell left, buckets too small, path too long for uint32, pause due.
FOUND, EMPTY, GROW, TOO_FAR, PAUSE = 0, 1, 2, 3, 4
PAUSE_CELLS = 1 << 17  # cells expanded between two pauses: about 2 ms


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

    A bucket is as wide as one straight move, so the distances of its cells are final when it opens, and only
    three buckets are needed at a time. `state` holds: lower bound of the open bucket, number of expanded
    cells, lowest and highest expanded cell, row of the open bucket, and the sizes of the three buckets.
    After PAUSE, or after GROW with larger buckets, the caller calls again and the search continues.
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
                continue  # an earlier bucket has settled it
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
    """Lower the distance of cell `j`. Returns 1 if the cell was added to the bucket that ends at `end`."""
    old = np.uint64(distance[j])
    if reached >= old:
        return np.uint64(0)
    distance[j] = reached
    if old < end:
        return np.uint64(0)  # it is in this bucket already
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
    """Like `flood`, but each move costs its length times the factor of the entered cell.

    A factor is at least 1, the width of a bucket. The buckets form a wheel. `offsets` lead to the neighbours:
    below, above, left, right, then the 4 diagonal ones. `state` is the open bucket and the number of expanded
    cells.
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
                if old >= due + 1:  # otherwise it is in that bucket already
                    turn = np.uint64(due & (WHEEL - 1))
                    buckets[turn, np.uint64(counts[turn])] = j
                    counts[turn] += 1
        counts[row] = 0
        bucket += one
    state[0], state[1] = bucket, expanded
    return outcome


@kernel
def descend(distance: NDArray[np.uint32], path: NDArray[np.uint64], width: Any, start: Any, goal: Any) -> int:
    """Write the cells of the path, goal first; returns their number."""
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
    """Write the cells of the path, goal first; returns their number."""
    i, length = goal, 0
    path[0] = i
    while i != start:
        i = _parent(distance, width, i, moves[0, costs[i]], moves[1, costs[i]])
        length += 1
        path[length] = i
    return length + 1


@kernel
def _parent(distance: Any, width: Any, i: Any, straight: Any, diagonal: Any) -> Any:
    """The neighbour from which cell `i` got its distance. Both sums are equal to the last bit."""
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
    return i  # never happens: every settled cell except the start has a parent
