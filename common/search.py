"""Exact shortest paths on a grid: Dinitz's buckets, compiled, many threads at once on one prepared map.

Moves are 8-connected, cost 1 and sqrt 2 times the cell's factor, and never cut a corner. What the cells
mean, and where the robot stands, is the business of `common.planner`.
"""

import math
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from common.flood import (
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
from common.wanted import check_wanted

FREE = np.uint32(2**32 - 1)
IDLE_MAX = 8  # workspaces kept for the next request; more may be in use for as long as they are

# Factor of entering a cell of cost 0..252, as NavFn weighs it; 253 and above are blocked.
FACTORS = (50.0 + 0.8 * np.arange(256)) / 50.0
# Rounded to 32 binary places (1e-10) sums of moves are exact, whatever their order: equal paths tie, as
# they should. With rounding noise instead, every tie is a store and a mispredicted branch.
MOVES = np.round(np.stack((FACTORS, FACTORS * math.sqrt(2))) * 2.0**32) / 2.0**32

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
    """The passable cells of one map, ready for searches from many threads."""

    def __init__(self, passable: NDArray[np.bool_]) -> None:
        height, self.width = passable.shape[0], passable.shape[1] + 2
        self._template = np.zeros((height + 2) * self.width, np.uint32)  # a blocked border: no bounds checks
        self._template.reshape(height + 2, self.width)[1:-1, 1:-1][passable] = FREE
        self._plain = _Pool(lambda: _PlainWorkspace(self._template, self.width))
        self._weighted = _Pool(lambda: _WeightedWorkspace(self._template, self.width))

    def route(
        self, start: Cell, goal: Cell, hits: Hits = NO_HITS, costs: NDArray[np.uint8] | None = None
    ) -> Route:
        """The cheapest path, with the discs of `hits` blocked; `costs` weighs every cell."""
        if costs is None:
            with self._plain.borrow() as plain:
                route = plain.route(start, goal, hits)
            if route is not None:
                return route
        with self._weighted.borrow() as weighted:
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


class _PlainWorkspace:
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
            outcome = self._flood(source, target)
            route = self._answer(outcome, source, target)
            self._reset()
        self._stamp(hits, blocked=False)
        return None if outcome == TOO_FAR else route

    def _flood(self, source: np.uint64, target: np.uint64) -> int:
        self._state[:] = (STRAIGHT, 0, 1, 0, 0, 0, source, source)
        self._distance[source] = STRAIGHT
        self._buckets[0, 0] = source
        while True:
            outcome = flood(self._distance, self._buckets, self._state, self._width, target, DISTANCE_MAX)
            if outcome == PAUSE:
                check_wanted()
            elif outcome == GROW:
                self._buckets = _grown(self._buckets)
            else:
                return outcome

    def _answer(self, outcome: int, source: np.uint64, target: np.uint64) -> Route:
        expanded = int(self._state[5])
        if outcome != FOUND:
            return no_route("NO_VALID_PATH", expanded)
        path = np.empty(int(self._distance[target]) // STRAIGHT, np.uint64)  # no move is cheaper
        cells = _cells(path[: descend(self._distance, path, self._width, source, target)], self._width)
        diagonal = int(np.abs(np.diff(cells, axis=0)).sum()) - (len(cells) - 1)
        return Route("NONE", cells, len(cells) - 1 - diagonal + diagonal * math.sqrt(2), expanded)

    def _reset(self) -> None:
        """Only the rows in reach of the last search."""
        margin = int(self._width) + 1
        span = slice(int(self._state[6]) - margin, int(self._state[7]) + margin + 1)
        self._distance[span] = self._template[span]

    def _stamp(self, hits: Hits, blocked: bool) -> None:
        stamp(self._distance, self._template, self._width, hits.rows, hits.cols, hits.reach, blocked)


class _WeightedWorkspace:
    """Distances in float64: 0 is blocked, infinity free, and the start has the bias of one move."""

    def __init__(self, template: NDArray[np.uint32], width: int) -> None:
        self._template, self._width = template, np.uint64(width)
        self._distance = np.zeros(template.size, np.float64)
        self._costs = np.zeros(template.size, np.uint8)
        self._buckets = np.zeros((WHEEL, _first_capacity(template, width)), np.uint32)
        self._counts = np.zeros(WHEEL, np.int64)
        self._state = np.zeros(2, np.int64)
        steps = (-width, width, -1, 1, -width - 1, -width + 1, width - 1, width + 1)
        self._offsets = np.array(steps, np.int64).view(np.uint64)

    def route(self, start: Cell, goal: Cell, hits: Hits, costs: NDArray[np.uint8] | None) -> Route:
        source, target = _index(start, self._width), _index(goal, self._width)
        self._load(hits, costs)
        status = _status(self._distance, source, target)
        if status != "NONE":
            return no_route(status)
        outcome = self._flood(source, target)
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

    def _flood(self, source: np.uint64, target: np.uint64) -> int:
        self._state[:] = (1, 0)
        self._counts[:] = 0
        self._counts[1] = 1
        self._buckets[1, 0] = source
        self._distance[source] = 1.0
        while True:
            outcome = flood_weighted(
                self._distance, self._costs, MOVES, self._buckets, self._counts, self._state,
                self._offsets, target,
            )  # fmt: skip
            if outcome == PAUSE:
                check_wanted()
            elif outcome == GROW:
                self._buckets = _grown(self._buckets)
            else:
                return outcome


def _index(cell: Cell, width: np.uint64) -> np.uint64:
    return np.uint64((cell[0] + 1) * int(width) + cell[1] + 1)


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


def _grown(buckets: NDArray[np.uint32]) -> NDArray[np.uint32]:
    grown = np.zeros((buckets.shape[0], 2 * buckets.shape[1]), np.uint32)
    grown[:, : buckets.shape[1]] = buckets
    return grown
