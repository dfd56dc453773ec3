"""Exact shortest paths on a prepared map, by three planners, for many threads at once.

Moves go to the 8 neighbours; they cost 1 or sqrt 2 times the factor of the entered cell, and never cut a
corner. A* and jump point search expand fewer cells than Dijkstra's algorithm (in `workspaces`), because they
know where the goal is; all find the same costs. `planner` decides which cells are blocked.
"""

import math
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from offboard.common.planning import ASTAR, DIJKSTRA, JPS, check_planner
from offboard.common.planning import jump_points as jump
from offboard.common.planning.a_star import AHEAD, AHEAD_WEIGHTED, FINE, seek
from offboard.common.planning.dijkstra import DIAGONAL, DISTANCE_MAX, STRAIGHT
from offboard.common.planning.workspaces import (
    MOVES,
    NO_HITS,
    Cell,
    Hits,
    PlainWorkspace,
    Route,
    WeightedWorkspace,
    Workspace,
    first_capacity,
    grown,
    no_route,
)

__all__ = ["NO_HITS", "Cell", "Field", "Hits", "Route", "no_route"]

FREE = np.uint32(2**32 - 1)
PLAIN_MOVES = np.array([[STRAIGHT], [DIAGONAL]], np.int64)
IDLE_MAX = 8  # workspaces kept for later searches; there is no limit on those in use

W = TypeVar("W")


class Field:
    """The passable cells of one map, ready for searches from many threads. `size` counts all cells."""

    def __init__(self, passable: NDArray[np.bool_]) -> None:
        self.size = passable.size
        height, width = passable.shape[0], passable.shape[1] + 2
        template = np.zeros((height + 2) * width, np.uint32)  # with a blocked border: no checks of bounds
        template.reshape(height + 2, width)[1:-1, 1:-1][passable] = FREE
        self._plain: dict[str, Pool[PlainWorkspace]] = {
            DIJKSTRA: Pool(lambda: PlainWorkspace(template, width)),
            ASTAR: Pool(lambda: AStarPlainWorkspace(template, width)),
            JPS: Pool(lambda: JumpWorkspace(template, width)),
        }
        self._weighted: dict[str, Pool[WeightedWorkspace]] = {
            DIJKSTRA: Pool(lambda: WeightedWorkspace(template, width)),
            ASTAR: Pool(lambda: AStarWeightedWorkspace(template, width)),
        }

    def route(
        self,
        start: Cell,
        goal: Cell,
        hits: Hits = NO_HITS,
        costs: NDArray[np.uint8] | None = None,
        planner: str = DIJKSTRA,
    ) -> Route:
        """The cheapest path. The discs of `hits` are blocked; `costs` weigh every cell (not with `jps`)."""
        check_planner(planner, weighted=costs is not None)
        if costs is None:
            with self._plain[planner].borrow() as plain:
                route = plain.route(start, goal, hits)
            if route is not None:
                return route
        with self._weighted[DIJKSTRA if planner == DIJKSTRA else ASTAR].borrow() as weighted:
            return weighted.route(start, goal, hits, costs)


class Pool(Generic[W]):
    """Lends workspaces, one per search. A workspace whose search failed is thrown away."""

    def __init__(self, make: Callable[[], W]) -> None:
        self._make = make
        self._idle: list[W] = []
        self._lock = threading.Lock()

    @contextmanager
    def borrow(self) -> Iterator[W]:
        with self._lock:
            workspace = self._idle.pop() if self._idle else None
        if workspace is None:
            workspace = self._make()
        yield workspace
        with self._lock:
            if len(self._idle) < IDLE_MAX:
                self._idle.append(workspace)


class _AStar(Workspace):
    """The steps of A*. Each cell in a bucket is stored with the distance that it had at that moment."""

    _moves: NDArray[Any]
    _unreached: float
    _ahead: int
    _weights: NDArray[np.uint8] | None = None

    def __init__(self, template: NDArray[np.uint32], width: int) -> None:
        super().__init__(template, width)
        self._buckets = np.zeros((self._ahead, max(first_capacity(template, width) // FINE, 1)), np.uint32)
        self._put_with = np.zeros(self._buckets.shape, self._distance.dtype)
        self._counts = np.zeros(self._ahead, np.uint64)

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
    _moves, _unreached, _ahead = PLAIN_MOVES, int(FREE), AHEAD


class AStarWeightedWorkspace(_AStar, WeightedWorkspace):
    _moves, _unreached, _ahead = MOVES, math.inf, AHEAD_WEIGHTED

    def __init__(self, template: NDArray[np.uint32], width: int) -> None:
        super().__init__(template, width)
        self._weights = self._costs


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
