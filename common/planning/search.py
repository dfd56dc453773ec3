"""Exact shortest paths on a grid: three planners, compiled, many threads at once on one prepared map.

Moves are 8-connected, cost 1 and sqrt 2 times the cell's factor, and never cut a corner. What the cells
mean, and where the robot stands, is the business of `planner`.
"""

import math
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from offboard.common.planning import jump_points as jump
from offboard.common.planning.a_star import AHEAD, AHEAD_WEIGHTED, FINE, seek
from offboard.common.planning.flood import (
    DIAGONAL,
    DISTANCE_MAX,
    FOUND,
    GROW,
    PAUSE,
    STRAIGHT,
    TOO_FAR,
    WHEEL,
    descend,
    descend_weighted,
    flood,
    flood_weighted,
    load,
    stamp,
)
from offboard.common.planning.planner_names import ASTAR, DIJKSTRA, JPS, check_planner
from offboard.common.wanted import check_wanted

FREE = np.uint32(2**32 - 1)
IDLE_MAX = 8  # workspaces kept for the next request; more may be in use for as long as they are

# Factor of entering a cell of cost 0..252, as NavFn weighs it; 253 and above are blocked.
FACTORS = (50.0 + 0.8 * np.arange(256)) / 50.0
# Rounded to 32 binary places (1e-10) sums of moves are exact, whatever their order: equal paths tie, as
# they should. With rounding noise instead, every tie is a store and a mispredicted branch.
MOVES = np.round(np.stack((FACTORS, FACTORS * math.sqrt(2))) * 2.0**32) / 2.0**32
PLAIN_MOVES = np.array([[STRAIGHT], [DIAGONAL]], np.int64)

Cell = tuple[int, int]
W = TypeVar("W")


@dataclass(frozen=True, slots=True)
class Hits:
    """Cells that a scan saw occupied, and how far around each (in cells) the robot cannot be."""

    rows: NDArray[np.int64]
    cols: NDArray[np.int64]
    reach: NDArray[np.float64]


NO_HITS = Hits(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.float64))


@dataclass(frozen=True, slots=True)
class Route:
    """`cells` are (row, col) from start to goal, empty unless `status` is NONE; `cost` is in cells."""

    status: str
    cells: NDArray[np.int32]
    cost: float
    expanded: int


class Field:
    """The passable cells of one map, of `size` cells in all, ready for searches from many threads."""

    def __init__(self, passable: NDArray[np.bool_]) -> None:
        self.size = passable.size
        height, self.width = passable.shape[0], passable.shape[1] + 2
        self._template = np.zeros((height + 2) * self.width, np.uint32)  # a blocked border: no bounds checks
        self._template.reshape(height + 2, self.width)[1:-1, 1:-1][passable] = FREE
        self._plain: dict[str, _Pool[_PlainWorkspace]] = {
            DIJKSTRA: _Pool(lambda: _PlainWorkspace(self._template, self.width)),
            ASTAR: _Pool(lambda: _InformedPlainWorkspace(self._template, self.width)),
            JPS: _Pool(lambda: _JumpWorkspace(self._template, self.width)),
        }
        self._weighted: dict[str, _Pool[_WeightedWorkspace]] = {
            DIJKSTRA: _Pool(lambda: _WeightedWorkspace(self._template, self.width)),
            ASTAR: _Pool(lambda: _InformedWeightedWorkspace(self._template, self.width)),
        }

    def route(
        self,
        start: Cell,
        goal: Cell,
        hits: Hits = NO_HITS,
        costs: NDArray[np.uint8] | None = None,
        planner: str = DIJKSTRA,
    ) -> Route:
        """The cheapest path, with the discs of `hits` blocked; `costs` (not by `jps`) weighs every cell."""
        check_planner(planner, weighted=costs is not None)
        if costs is None:
            with self._plain[planner].borrow() as plain:
                route = plain.route(start, goal, hits)
            if route is not None:
                return route
        with self._weighted[DIJKSTRA if planner == DIJKSTRA else ASTAR].borrow() as weighted:
            return weighted.route(start, goal, hits, costs)


class _Pool(Generic[W]):
    """Workspaces to borrow; one whose search failed is not put back."""

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


class _Workspace(ABC):
    """What one search at a time needs beside the map."""

    _width: np.uint64
    _distance: NDArray[Any]
    _buckets: NDArray[np.uint32]
    _counts: NDArray[Any]
    _state: NDArray[np.int64]  # `_state[1]` is what was expanded

    def _search(self, source: np.uint64, target: np.uint64) -> int:
        self._begin(source, target)
        while (outcome := self._go_on(target)) in (PAUSE, GROW):
            if outcome == PAUSE:
                check_wanted()
            else:
                self._grow()
        return outcome

    @abstractmethod
    def _begin(self, source: np.uint64, target: np.uint64) -> None: ...

    @abstractmethod
    def _go_on(self, target: np.uint64) -> int: ...

    @abstractmethod
    def _grow(self) -> None: ...


class _PlainWorkspace(_Workspace):
    """Distances in uint32: 0 is blocked, all ones free, and the start has the bias of one move."""

    def __init__(self, template: NDArray[np.uint32], width: int) -> None:
        self._template, self._width = template, np.uint64(width)
        self._distance = template.copy()
        self._buckets = np.zeros((3, _first_capacity(template, width)), np.uint32)
        self._state = np.zeros(8, np.int64)

    def route(self, start: Cell, goal: Cell, hits: Hits) -> Route | None:
        """None when the path may be longer than uint32 can count."""
        source, target = _index(start, self._width), _index(goal, self._width)
        self._stamp(hits, blocked=True)
        status = _status(self._distance, source, target)
        outcome, route = FOUND, no_route(status)
        if status == "NONE":
            outcome = self._search(source, target)
            route = self._answer(outcome, source, target)
            self._reset()
        self._stamp(hits, blocked=False)
        return None if outcome == TOO_FAR else route

    def _begin(self, source: np.uint64, target: np.uint64) -> None:  # noqa: ARG002 - the flood has no aim
        self._state[:] = (STRAIGHT, 0, source, source, 0, 1, 0, 0)
        self._distance[source] = STRAIGHT
        self._buckets[0, 0] = source

    def _go_on(self, target: np.uint64) -> int:
        return flood(self._distance, self._buckets, self._state, self._width, target, DISTANCE_MAX)

    def _grow(self) -> None:
        self._buckets = _grown(self._buckets)

    def _answer(self, outcome: int, source: np.uint64, target: np.uint64) -> Route:
        expanded = int(self._state[1])
        if outcome != FOUND:
            return no_route("NO_VALID_PATH", expanded)
        path = np.empty(int(self._distance[target]) // STRAIGHT, np.uint64)  # no move is cheaper
        cells = _cells(path[: self._descend(path, source, target)], self._width)
        diagonal = int(np.abs(np.diff(cells, axis=0)).sum()) - (len(cells) - 1)
        return Route("NONE", cells, len(cells) - 1 - diagonal + diagonal * math.sqrt(2), expanded)

    def _descend(self, path: NDArray[np.uint64], source: np.uint64, target: np.uint64) -> int:
        return descend(self._distance, path, self._width, source, target)

    def _reset(self) -> None:
        """Only the rows in reach of the last search."""
        margin = int(self._width) + 1
        span = slice(int(self._state[2]) - margin, int(self._state[3]) + margin + 1)
        self._distance[span] = self._template[span]

    def _stamp(self, hits: Hits, blocked: bool) -> None:
        stamp(self._distance, self._template, self._width, hits.rows, hits.cols, hits.reach, blocked)


class _JumpWorkspace(_PlainWorkspace):
    """Distances are those of jump points; the free cells are bits too, by rows and by columns."""

    def __init__(self, template: NDArray[np.uint32], width: int) -> None:
        super().__init__(template, width)
        free = template.reshape(-1, width) != 0
        self._rows, self._cols = jump.bits(free), jump.bits(free.T)
        self._nodes = np.zeros((3, 2 * jump.NODES_MAX), np.uint32)
        self._heap = np.zeros(self._nodes.shape[1], np.uint64)
        self._state = np.zeros(jump.STATES, np.int64)

    def _begin(self, source: np.uint64, target: np.uint64) -> None:
        least = _least(source, target, self._width, STRAIGHT, DIAGONAL)
        self._state[:] = 0
        self._state[[jump.MADE, jump.OPEN, jump.TOO_LONG]] = 1, least <= DISTANCE_MAX, least > DISTANCE_MAX
        self._state[[jump.GOAL, jump.WIDTH]] = target, self._width
        self._state[[jump.GOAL_ROW, jump.GOAL_COL]] = divmod(int(target), int(self._width))
        self._nodes[:, 0] = source, 0, jump.STANDING
        self._heap[0] = min(least, DISTANCE_MAX) << 32 | int(jump.LOW)
        self._distance[source] = STRAIGHT

    def _go_on(self, target: np.uint64) -> int:  # noqa: ARG002 - it is in the state
        return jump.search(self._distance, self._rows, self._cols, self._nodes, self._heap, self._state)

    def _grow(self) -> None:
        self._nodes, self._heap = _grown(self._nodes), _grown(self._heap[None])[0]

    def _descend(self, path: NDArray[np.uint64], source: np.uint64, target: np.uint64) -> int:  # noqa: ARG002
        return jump.trace(self._nodes, path, int(self._state[jump.LAST]), int(self._width))

    def _reset(self) -> None:
        self._distance[self._nodes[jump.CELL, : self._state[jump.MADE]]] = FREE

    def _stamp(self, hits: Hits, blocked: bool) -> None:
        super()._stamp(hits, blocked)
        jump.stamp(
            self._rows, self._cols, self._template, int(self._width),
            hits.rows, hits.cols, hits.reach, blocked,
        )  # fmt: skip


class _WeightedWorkspace(_Workspace):
    """Distances in float64: 0 is blocked, infinity free, and the start has the bias of one move."""

    def __init__(self, template: NDArray[np.uint32], width: int) -> None:
        self._template, self._width = template, np.uint64(width)
        self._distance = np.zeros(template.size, np.float64)
        self._costs = np.zeros(template.size, np.uint8)
        self._buckets = np.zeros((WHEEL, _first_capacity(template, width)), np.uint32)
        self._counts = np.zeros(WHEEL, np.int64)
        self._state = np.zeros(4, np.int64)
        steps = (-width, width, -1, 1, -width - 1, -width + 1, width - 1, width + 1)
        self._offsets = np.array(steps, np.int64).view(np.uint64)

    def route(self, start: Cell, goal: Cell, hits: Hits, costs: NDArray[np.uint8] | None) -> Route:
        source, target = _index(start, self._width), _index(goal, self._width)
        self._load(hits, costs)
        status = _status(self._distance, source, target)
        if status != "NONE":
            return no_route(status)
        outcome = self._search(source, target)
        expanded = int(self._state[1])
        if outcome != FOUND:
            return no_route("NO_VALID_PATH", expanded)
        cost = float(self._distance[target]) - 1.0
        path = np.empty(int(self._distance[target]) + 1, np.uint64)
        length = descend_weighted(self._distance, self._costs, MOVES, path, self._width, source, target)
        return Route("NONE", _cells(path[:length], self._width), cost, expanded)

    def _load(self, hits: Hits, costs: NDArray[np.uint8] | None) -> None:
        if costs is None:
            self._costs[:] = 0
        else:
            self._costs.reshape(-1, int(self._width))[1:-1, 1:-1] = costs
        load(self._distance, self._template, self._costs)
        stamp(self._distance, self._distance, self._width, hits.rows, hits.cols, hits.reach, True)

    def _begin(self, source: np.uint64, target: np.uint64) -> None:  # noqa: ARG002 - the flood has no aim
        self._state[:2] = (1, 0)
        self._counts[:] = 0
        self._counts[1] = 1
        self._buckets[1, 0] = source
        self._distance[source] = 1.0

    def _go_on(self, target: np.uint64) -> int:
        return flood_weighted(
            self._distance, self._costs, MOVES, self._buckets, self._counts, self._state,
            self._offsets, target,
        )  # fmt: skip

    def _grow(self) -> None:
        self._buckets = _grown(self._buckets)


class _Informed(_Workspace):
    """A* in place of a flood: beside the cells in its buckets are the distances they were put there with."""

    _moves: NDArray[Any]
    _unreached: float
    _weights: NDArray[np.uint8] | None = None

    def _make_buckets(self, ahead: int, capacity: int) -> None:
        self._buckets = np.zeros((ahead, max(capacity // FINE, 1)), np.uint32)
        self._put_with = np.zeros(self._buckets.shape, self._distance.dtype)
        self._counts = np.zeros(ahead, np.uint64)

    def _begin(self, source: np.uint64, target: np.uint64) -> None:
        straight, diagonal = self._moves[:, 0].tolist()
        bucket = int(FINE / straight * _least(source, target, self._width, straight, diagonal))
        turn = bucket % len(self._counts)
        self._state[:4] = bucket, 0, source, source
        self._counts[:] = 0
        self._counts[turn], self._buckets[turn, 0], self._put_with[turn, 0] = 1, source, straight
        self._distance[source] = straight

    def _go_on(self, target: np.uint64) -> int:
        return seek(
            self._distance, self._weights, self._moves, self._buckets, self._put_with, self._counts,
            self._state, int(self._width), int(target), self._unreached,
        )  # fmt: skip

    def _grow(self) -> None:
        self._buckets, self._put_with = _grown(self._buckets), _grown(self._put_with)


class _InformedPlainWorkspace(_Informed, _PlainWorkspace):
    _moves, _unreached = PLAIN_MOVES, int(FREE)

    def __init__(self, template: NDArray[np.uint32], width: int) -> None:
        super().__init__(template, width)
        self._make_buckets(AHEAD, _first_capacity(template, width))


class _InformedWeightedWorkspace(_Informed, _WeightedWorkspace):
    _moves, _unreached = MOVES, math.inf

    def __init__(self, template: NDArray[np.uint32], width: int) -> None:
        super().__init__(template, width)
        self._weights = self._costs
        self._make_buckets(AHEAD_WEIGHTED, _first_capacity(template, width))


def _index(cell: Cell, width: np.uint64) -> np.uint64:
    return np.uint64((cell[0] + 1) * int(width) + cell[1] + 1)


def _least(source: np.uint64, target: np.uint64, width: np.uint64, straight: Any, diagonal: Any) -> Any:
    """The octile distance, and the bias of one move."""
    (row, col), (goal_row, goal_col) = (divmod(int(cell), int(width)) for cell in (source, target))
    less, more = sorted((abs(goal_row - row), abs(goal_col - col)))
    return straight + less * diagonal + (more - less) * straight


def _cells(path: NDArray[np.uint64], width: np.uint64) -> NDArray[np.int32]:
    """Goal-first padded indices as (row, col) from the start."""
    rows, cols = np.divmod(path[::-1].astype(np.int64), int(width))
    return np.stack((rows - 1, cols - 1), axis=1).astype(np.int32)


def _status(distance: NDArray[Any], source: np.uint64, target: np.uint64) -> str:
    if distance[source] == 0:
        return "START_OCCUPIED"
    return "GOAL_OCCUPIED" if distance[target] == 0 else "NONE"


def no_route(status: str, expanded: int = 0) -> Route:
    return Route(status, np.zeros((0, 2), np.int32), 0.0, expanded)


def _first_capacity(template: NDArray[np.uint32], width: int) -> int:
    """Room for a frontier as long as the map is round; more is grown when a maze needs it."""
    return 16 * (template.size // width + width)


def _grown(rows: NDArray[Any]) -> NDArray[Any]:
    grown = np.zeros((rows.shape[0], 2 * rows.shape[1]), rows.dtype)
    grown[:, : rows.shape[1]] = rows
    return grown
