"""The compiled kernels of jump point search (Harabor and Grastien 2011, 2014), without cutting corners.

Of all shortest paths it looks for the one that makes its diagonal moves first. Such a path leaves a straight
line only at a jump point, where a wall beside the line ends. The kernel finds jump points by scanning lines,
64 cells at a time: each bit of a word is set where a cell is free. There is one set of words for rows and one
for columns. A diagonal is followed cell by cell, and from each cell both straight directions are scanned.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.common.planning.a_star import octile
from offboard.common.planning.compiled import kernel
from offboard.common.planning.dijkstra import (
    DIAGONAL,
    DISTANCE_MAX,
    EMPTY,
    FOUND,
    GROW,
    PAUSE,
    PAUSE_CELLS,
    STRAIGHT,
    TOO_FAR,
)

STRIDE = 64  # cells of a diagonal that are followed at a time; the rest goes onto the heap
NODES_MAX = 4 * (2 * STRIDE + 2) + 4  # nodes that one expansion adds, at most

CELL, SOURCE, WAY = 0, 1, 2  # rows of `nodes`; a way is a direction: 4 + 3 * row step + column step
STANDING = 4  # the way of the start: no direction
STATES = 10
OPEN, EXPANDED, MADE, LOOKS, TOO_LONG, LAST, GOAL, GOAL_ROW, GOAL_COL, WIDTH = range(STATES)

ONE, HALF, TOP = np.uint64(1), np.uint64(32), np.uint64(63)
LOW, ALL = np.uint64(2**32 - 1), np.uint64(2**64 - 1)
# The position of a single bit: the top six bits of its product with a de Bruijn sequence (Leiserson 1998).
SEQUENCE, LEFT_OVER = np.uint64(0x03F79D71B4CB0A89), np.uint64(58)
PLACES = np.argsort([(int(SEQUENCE) << place) % 2**64 >> 58 for place in range(64)])


@kernel
def search(
    distance: NDArray[np.uint32],
    rows: NDArray[np.uint64],
    cols: NDArray[np.uint64],
    nodes: NDArray[np.uint32],
    heap: NDArray[np.uint64],
    state: NDArray[np.int64],
) -> int:
    """Expand jump points in the order of the least cost of a path through them. One loop, for speed.

    Of equal ones the newest comes first. `distance` is set for jump points only. After PAUSE, or after GROW
    with larger `nodes` and `heap`, the caller calls again and the search continues. A look covers up to 64
    cells and takes twice as long as one cell in Dijkstra's algorithm.
    """
    pause = state[LOOKS] + PAUSE_CELLS // 2
    goal, goal_row, goal_col, width = state[GOAL], state[GOAL_ROW], state[GOAL_COL], state[WIDTH]
    while True:
        if state[OPEN] == 0:
            return TOO_FAR if state[TOO_LONG] else EMPTY
        if state[MADE] + NODES_MAX > nodes.shape[1]:
            return GROW
        if state[LOOKS] >= pause:
            return PAUSE
        entry = _pop(heap, state)
        node = np.int64(LOW - (entry & LOW))
        cell = np.int64(nodes[CELL, node])
        if cell == goal:
            state[LAST] = node
            return FOUND
        row, col = cell // width, cell % width
        reached = np.int64(entry >> HALF) - octile(row - goal_row, col - goal_col, STRAIGHT, DIAGONAL)
        if distance[cell] < reached:
            continue
        state[EXPANDED] += 1
        ways = _ways(rows, row, col, np.int64(nodes[WAY, node]))
        for way in range(9):
            if not ways >> way & 1:
                continue
            down, over = way // 3 - 1, way % 3 - 1
            diagonal = down != 0 and over != 0
            going_on = diagonal
            r, c, d = row, col, reached
            for _ in range(STRIDE if diagonal else 1):
                if diagonal:
                    beside = _free(rows, r + down, c) and _free(rows, r, c + over)
                    r, c, d = r + down, c + over, d + DIAGONAL
                    if not (beside and _free(rows, r, c)):
                        going_on = False
                        break
                    least = d + octile(r - goal_row, c - goal_col, STRAIGHT, DIAGONAL)
                    state[TOO_LONG] |= least > DISTANCE_MAX
                    if least > DISTANCE_MAX or least >= distance[goal]:
                        going_on = False
                        break
                    if r == goal_row and c == goal_col:
                        distance[goal] = d
                        break  # it goes onto the heap, like the end of a stride
                for part in range(2):  # first along the column, then along the row
                    step = over if part else down
                    if step == 0:
                        continue
                    stop = _stop(rows, r, c, step) if part else _stop(cols, c, r, step)
                    length = abs(stop - (c if part else r))
                    ahead = ((goal_col - c) if part else (goal_row - r)) * step
                    if (r == goal_row if part else c == goal_col) and 0 < ahead <= length:
                        length = ahead
                    state[LOOKS] += 1 + (length >> 6)
                    to_row, to_col = r + (0 if part else step * length), c + (step * length if part else 0)
                    if not _free(rows, to_row, to_col):
                        continue
                    j, d_there = to_row * width + to_col, d + STRAIGHT * length
                    least = d_there + octile(to_row - goal_row, to_col - goal_col, STRAIGHT, DIAGONAL)
                    state[TOO_LONG] |= least > DISTANCE_MAX
                    if least <= DISTANCE_MAX and least < distance[goal] and d_there < distance[j]:
                        distance[j] = d_there
                        _push(nodes, heap, state, j, node, 4 + (step if part else 3 * step), least)
            if going_on:
                least = d + octile(r - goal_row, c - goal_col, STRAIGHT, DIAGONAL)
                _push(nodes, heap, state, r * width + c, node, way, least)


@kernel
def _ways(rows: Any, row: Any, col: Any, way: Any) -> Any:
    """The directions to search from a jump point, as bits, including those around the end of a wall."""
    if way == STANDING:
        return 0b111101111
    down, over, ways = way // 3 - 1, way % 3 - 1, 1 << way
    if down == 0 or over == 0:
        for side in (-1, 1):
            if down == 0:
                if _free(rows, row + side, col) and not _free(rows, row + side, col - over):
                    ways |= 1 << (4 + 3 * side) | 1 << (4 + 3 * side + over)
            elif _free(rows, row, col + side) and not _free(rows, row - down, col + side):
                ways |= 1 << (4 + side) | 1 << (4 + 3 * down + side)
    return ways


@kernel
def _stop(bits: Any, line: Any, at: Any, step: Any) -> Any:
    """The first cell after `at` that is blocked, or that has the end of a wall beside it."""
    i, word, place = np.uint64(line), np.uint64(at >> 6), np.uint64(at & 63)
    if step > 0:
        left, right = np.uint64(0), np.uint64(0)  # the last cell of the word before, on both sides
        mask = ALL << place << ONE
        while True:
            one_side, other = bits[i - ONE, word], bits[i + ONE, word]
            ends = (one_side & ~(one_side << ONE | left)) | (other & ~(other << ONE | right))
            found = (ends | ~bits[i, word]) & mask
            if found != 0:
                return np.int64(word) * 64 + _place(found & (~found + ONE))
            left, right, mask, word = one_side >> TOP, other >> TOP, ALL, word + ONE
    left, right = np.uint64(0), np.uint64(0)
    mask = (ONE << place) - ONE
    while True:
        one_side, other = bits[i - ONE, word], bits[i + ONE, word]
        ends = (one_side & ~(one_side >> ONE | left)) | (other & ~(other >> ONE | right))
        found = (ends | ~bits[i, word]) & mask
        if found != 0:
            for shift in (1, 2, 4, 8, 16, 32):
                found |= found >> np.uint64(shift)
            return np.int64(word) * 64 + _place(found ^ (found >> ONE))
        left, right, mask, word = one_side << TOP, other << TOP, ALL, word - ONE


@kernel
def _place(bit: Any) -> Any:
    return PLACES[(bit * SEQUENCE) >> LEFT_OVER]


@kernel
def _free(bits: Any, line: Any, at: Any) -> Any:
    return (bits[np.uint64(line), np.uint64(at >> 6)] >> np.uint64(at & 63)) & ONE != 0


@kernel
def _push(nodes: Any, heap: Any, state: Any, cell: Any, source: Any, way: Any, least: Any) -> None:
    made, k = state[MADE], state[OPEN]
    nodes[CELL, made], nodes[SOURCE, made], nodes[WAY, made] = cell, source, way
    entry = np.uint64(least) << HALF | (LOW - np.uint64(made))
    while k > 0 and entry < heap[(k - 1) >> 1]:
        heap[k] = heap[(k - 1) >> 1]
        k = (k - 1) >> 1
    heap[k] = entry
    state[MADE] += 1
    state[OPEN] += 1


@kernel
def _pop(heap: Any, state: Any) -> Any:
    first, count = heap[0], state[OPEN] - 1
    entry, k, below = heap[count], 0, 1
    state[OPEN] = count
    while below < count:
        if below + 1 < count and heap[below + 1] < heap[below]:
            below += 1
        if entry <= heap[below]:
            break
        heap[k] = heap[below]
        k, below = below, 2 * below + 1
    heap[k] = entry
    return first


@kernel
def trace(nodes: NDArray[np.uint32], path: NDArray[np.uint64], last: int, width: int) -> int:
    """Write the cells of the path, goal first; returns their number.

    The way from one node to the next is a diagonal followed by a straight line.
    """
    length, node = 1, np.int64(last)
    cell = np.int64(nodes[CELL, node])
    path[0] = cell
    while nodes[WAY, node] != STANDING:
        node = np.int64(nodes[SOURCE, node])
        end = np.int64(nodes[CELL, node])
        while cell != end:
            rows, cols = end // width - cell // width, end % width - cell % width
            down = np.sign(rows) if abs(rows) >= abs(cols) else 0
            over = np.sign(cols) if abs(cols) >= abs(rows) else 0
            cell += down * width + over
            path[length] = cell
            length += 1
    return length


def bits(free: NDArray[np.bool_]) -> NDArray[np.uint64]:
    """Each line as words of 64 cells; the first cell is the lowest bit."""
    packed = np.packbits(np.pad(free, ((0, 0), (0, -free.shape[1] % 64))), axis=1, bitorder="little")
    return np.ascontiguousarray(packed).view("<u8").astype(np.uint64)


@kernel
def stamp(
    rows: NDArray[np.uint64],
    cols: NDArray[np.uint64],
    template: NDArray[np.uint32],
    width: int,
    hit_rows: NDArray[np.int64],
    hit_cols: NDArray[np.int64],
    reach: NDArray[np.float64],
    blocked: bool,
) -> None:
    """Like `grid_kernels.stamp`, on the bits of rows and of columns."""
    height = template.size // width
    for k in range(hit_rows.size):
        row, col, radius = hit_rows[k] + 1, hit_cols[k] + 1, int(reach[k])
        for r in range(max(row - radius, 1), min(row + radius, height - 2) + 1):
            for c in range(max(col - radius, 1), min(col + radius, width - 2) + 1):
                if (r - row) ** 2 + (c - col) ** 2 <= reach[k] * reach[k] and template[r * width + c] != 0:
                    down, over = ONE << np.uint64(r & 63), ONE << np.uint64(c & 63)
                    if blocked:
                        rows[r, c >> 6] &= ~over
                        cols[c, r >> 6] &= ~down
                    else:
                        rows[r, c >> 6] |= over
                        cols[c, r >> 6] |= down
