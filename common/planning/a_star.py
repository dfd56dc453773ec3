"""The compiled kernel of A*: buckets as in `dijkstra`, ordered by a lower bound of the path through a cell.

This bound is the distance to the cell plus the octile distance from there to the goal. It never falls along a
move. A move straight towards the goal adds nothing to it, so a cell may be lowered while its bucket is open.
Therefore the kernel works through a bucket, newest cell first, until it is empty.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.common.planning.compiled import kernel
from offboard.common.planning.dijkstra import EMPTY, FOUND, GROW, PAUSE, PAUSE_CELLS, TOO_FAR

FINE = 2  # buckets per straight move: with 1 a fifth more cells are expanded, with 4 no fewer
# Circular buckets: the most expensive move, away from the goal, spans 6 (2 * 2 sqrt 2), with costs 18.
AHEAD, AHEAD_WEIGHTED = 8, 32
TURNS = 64  # cells expanded, at least, between two checks of how full the buckets are
ROWS, COLS = (-1, 1, 0, 0, -1, -1, 1, 1), (0, 0, -1, 1, -1, 1, -1, 1)  # to the neighbours
ONE = np.uint64(1)


@kernel
def seek(
    distance: NDArray[Any],
    costs: NDArray[np.uint8] | None,
    moves: NDArray[Any],
    buckets: NDArray[np.uint32],
    put_with: NDArray[Any],
    counts: NDArray[np.uint64],
    state: NDArray[np.int64],
    width: int,
    goal: int,
    unreached: Any,
) -> int:
    """Expand cells until no remaining cell can lead to a shorter path. One loop, for the speed of `dijkstra`.

    `put_with` is the distance that each cell had when it was put into its bucket; if its distance differs
    now, it was lowered in the meantime. `unreached` is the distance of a free cell. `state` holds the open
    bucket, the number of expanded cells, and the lowest and highest of them. After PAUSE, or after GROW with
    larger buckets, the caller calls again and the search continues.
    """
    bucket, expanded = np.uint64(state[0]), np.uint64(state[1])
    lowest, highest = np.uint64(state[2]), np.uint64(state[3])
    # A cell takes twice as long as in Dijkstra's algorithm.
    pause, mask = expanded + np.uint64(PAUSE_CELLS // 2), np.uint64(counts.size - 1)
    goal_row, goal_col, end = goal // width, goal % width, np.uint64(goal)
    straight, diagonal = moves[0, 0], moves[1, 0]
    fine = FINE / straight
    outcome = EMPTY
    while True:
        turn = bucket & mask
        if counts[turn] == 0:
            if bucket > fine * distance[end] or counts.sum() == 0:
                outcome = FOUND if distance[end] < unreached else EMPTY
                break
            bucket += ONE
            continue
        if bucket > fine * (unreached - 4 * straight):  # one more move could overflow
            outcome = TOO_FAR
            break
        if expanded >= pause:
            outcome = PAUSE
            break
        turns = (np.uint64(buckets.shape[1]) - counts.max()) >> np.uint64(3)
        if turns < np.uint64(TURNS):
            outcome = GROW
            break
        turns = min(turns, pause - expanded)
        while counts[turn] != 0 and turns != 0:
            counts[turn] -= ONE
            i, d = np.uint64(buckets[turn, counts[turn]]), put_with[turn, counts[turn]]
            if d != distance[i]:
                continue
            row = np.int64(i) // width
            col = np.int64(i) - row * width
            if d + octile(row - goal_row, col - goal_col, straight, diagonal) >= distance[end]:
                continue
            expanded, turns = expanded + ONE, turns - ONE
            lowest, highest = min(lowest, i), max(highest, i)
            for n in range(8):
                j = np.uint64(np.int64(i) + ROWS[n] * width + COLS[n])
                reached = d + (moves[n // 4, 0] if costs is None else moves[n // 4, costs[j]])
                if reached >= distance[j]:
                    continue
                if n >= 4 and (
                    distance[np.uint64(np.int64(i) + COLS[n])] == 0
                    or distance[np.uint64(np.int64(i) + ROWS[n] * width)] == 0
                ):
                    continue
                distance[j] = reached
                least = reached + octile(
                    row + ROWS[n] - goal_row, col + COLS[n] - goal_col, straight, diagonal
                )
                if least >= distance[end]:
                    continue
                # In a path of millions of cells, rounding may point to a bucket that is closed already.
                due = max(np.uint64(np.int64(fine * least)), bucket) & mask
                buckets[due, counts[due]], put_with[due, counts[due]] = j, reached
                counts[due] += ONE
    state[0], state[1], state[2], state[3] = bucket, expanded, lowest, highest
    return outcome


@kernel
def octile(rows: Any, cols: Any, straight: Any, diagonal: Any) -> Any:
    """The length of the shortest path across these rows and columns if all cells were free."""
    rows, cols = abs(rows), abs(cols)
    return diagonal * min(rows, cols) + straight * (max(rows, cols) - min(rows, cols))
