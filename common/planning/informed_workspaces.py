"""Workspaces for A* and jump point search, which expand fewer cells because they know where the goal is.

They find the same costs as the workspaces of Dijkstra's algorithm in `workspaces`.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.common.planning import jump_points as jump
from offboard.common.planning.a_star import AHEAD, AHEAD_WEIGHTED, FINE, seek
from offboard.common.planning.dijkstra import DIAGONAL, DISTANCE_MAX, STRAIGHT
from offboard.common.planning.route import Hits
from offboard.common.planning.workspaces import (
    MOVES,
    PlainWorkspace,
    WeightedWorkspace,
    Workspace,
    first_capacity,
    grown,
)

FREE = np.uint32(2**32 - 1)
PLAIN_MOVES = np.array([[STRAIGHT], [DIAGONAL]], np.int64)


class _AStar(Workspace):
    """The steps of A*. Each cell in a bucket is stored with the distance that it had at that moment."""

    _moves: NDArray[Any]
    _unreached: float
    _weights: NDArray[np.uint8] | None = None

    def _make_buckets(self, ahead: int, capacity: int) -> None:
        self._buckets = np.zeros((ahead, max(capacity // FINE, 1)), np.uint32)
        self._put_with = np.zeros(self._buckets.shape, self._distance.dtype)
        self._counts = np.zeros(ahead, np.uint64)

    def _begin(self, source: np.uint64, target: np.uint64) -> None:
        straight, diagonal = self._moves[:, 0].tolist()
        bucket = int(FINE / straight * _least(source, target, self._width, (straight, diagonal)))
        turn = bucket % len(self._counts)
        self._state[:4] = bucket, 0, source, source
        self._counts[:] = 0
        self._counts[turn], self._buckets[turn, 0], self._put_with[turn, 0] = 1, source, straight
        self._distance[source] = straight

    def _go_on(self, target: np.uint64) -> int:
        return seek(
            self._distance, self._weights, self._moves, self._buckets,
            put_with=self._put_with, counts=self._counts, state=self._state,
            width=int(self._width), goal=int(target), unreached=self._unreached,
        )  # fmt: skip

    def _grow(self) -> None:
        self._buckets, self._put_with = grown(self._buckets), grown(self._put_with)


class AStarPlainWorkspace(_AStar, PlainWorkspace):
    _moves, _unreached = PLAIN_MOVES, int(FREE)

    def __init__(self, template: NDArray[np.uint32], width: int) -> None:
        super().__init__(template, width)
        self._make_buckets(AHEAD, first_capacity(template, width))


class AStarWeightedWorkspace(_AStar, WeightedWorkspace):
    _moves, _unreached = MOVES, math.inf

    def __init__(self, template: NDArray[np.uint32], width: int) -> None:
        super().__init__(template, width)
        self._weights = self._costs
        self._make_buckets(AHEAD_WEIGHTED, first_capacity(template, width))


class JumpWorkspace(PlainWorkspace):
    """Jump point search. Only jump points have distances; free cells are also bits, by row and by column."""

    def __init__(self, template: NDArray[np.uint32], width: int) -> None:
        super().__init__(template, width)
        free = template.reshape(-1, width) != 0
        self._rows, self._cols = jump.bits(free), jump.bits(free.T)
        self._nodes = np.zeros((3, 2 * jump.NODES_MAX), np.uint32)
        self._heap = np.zeros(self._nodes.shape[1], np.uint64)
        self._state = np.zeros(jump.STATES, np.int64)

    def _begin(self, source: np.uint64, target: np.uint64) -> None:
        least = _least(source, target, self._width, (STRAIGHT, DIAGONAL))
        self._state[:] = 0
        self._state[[jump.MADE, jump.OPEN, jump.TOO_LONG]] = 1, least <= DISTANCE_MAX, least > DISTANCE_MAX
        self._state[[jump.GOAL, jump.WIDTH]] = target, self._width
        self._state[[jump.GOAL_ROW, jump.GOAL_COL]] = divmod(int(target), int(self._width))
        self._nodes[:, 0] = source, 0, jump.STANDING
        self._heap[0] = min(least, DISTANCE_MAX) << 32 | int(jump.LOW)
        self._distance[source] = STRAIGHT

    def _go_on(self, target: np.uint64) -> int:  # noqa: ARG002 - the goal is in the state
        return jump.search(
            self._distance, self._rows, self._cols, nodes=self._nodes, heap=self._heap, state=self._state
        )

    def _grow(self) -> None:
        self._nodes, self._heap = grown(self._nodes), grown(self._heap[None])[0]

    def _descend(self, path: NDArray[np.uint64], source: np.uint64, target: np.uint64) -> int:  # noqa: ARG002
        return jump.trace(self._nodes, path, int(self._state[jump.LAST]), int(self._width))

    def _reset(self) -> None:
        self._distance[self._nodes[jump.CELL, : self._state[jump.MADE]]] = FREE

    def _stamp(self, hits: Hits, *, blocked: bool) -> None:
        super()._stamp(hits, blocked=blocked)
        jump.stamp(
            self._rows, self._cols, self._template, int(self._width),
            hit_rows=hits.rows, hit_cols=hits.cols, reach=hits.reach, blocked=blocked,
        )  # fmt: skip


def _least(source: np.uint64, target: np.uint64, width: np.uint64, moves: tuple[Any, Any]) -> Any:
    """A lower bound of the distance at the goal: one move for the start, and the octile distance."""
    straight, diagonal = moves
    (row, col), (goal_row, goal_col) = (divmod(int(cell), int(width)) for cell in (source, target))
    less, more = sorted((abs(goal_row - row), abs(goal_col - col)))
    return straight + less * diagonal + (more - less) * straight
