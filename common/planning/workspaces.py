"""Input, result and arrays of one search, and the steps around the kernels of Dijkstra's algorithm."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.common.planning.dijkstra import (
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
)
from offboard.common.planning.grid_kernels import load, stamp
from offboard.common.task_call import check_wanted

Cell = tuple[int, int]  # row, column
# Factor of entering a cell of cost 0 to 252, as NavFn weighs it; 253 and above are blocked.
FACTORS = (50.0 + 0.8 * np.arange(256)) / 50.0
# Rounded to 32 binary places (1e-10), sums of moves are exact in any order, so that equal paths tie.
# With rounding noise instead, every tie would cost a store and a mispredicted branch.
MOVES = np.round(np.stack((FACTORS, FACTORS * math.sqrt(2))) * 2.0**32) / 2.0**32


@dataclass(frozen=True, slots=True)
class Hits:
    """Cells that a scan saw occupied. The robot cannot be within `reach` cells of them."""

    rows: NDArray[np.int64]
    cols: NDArray[np.int64]
    reach: NDArray[np.float64]


NO_HITS = Hits(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.float64))


@dataclass(frozen=True, slots=True)
class Route:
    """A path over cells, or the reason why there is none.

    `cells` are (row, column) from start to goal; they are empty unless `status` is NONE. `cost` is in cells.
    """

    status: str
    cells: NDArray[np.int32]
    cost: float
    expanded: int


def no_route(status: str, expanded: int = 0) -> Route:
    return Route(status, np.zeros((0, 2), np.int32), 0.0, expanded)


class Workspace(ABC):
    """The arrays that one search needs besides the map."""

    _distance: NDArray[Any]
    _buckets: NDArray[np.uint32]
    _counts: NDArray[Any]
    _state: NDArray[np.int64]  # `_state[1]` is the number of expanded cells

    def __init__(self, template: NDArray[np.uint32], width: int) -> None:
        self._template, self._width = template, np.uint64(width)

    def _search(self, source: np.uint64, target: np.uint64) -> int:
        """Run the kernel to its end. At each pause the task may stop, if nobody waits for it any more."""
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


class PlainWorkspace(Workspace):
    """For cells without costs. Distances are uint32: 0 is blocked, all ones is free.

    The start has the distance of one move, because 0 means blocked.
    """

    def __init__(self, template: NDArray[np.uint32], width: int) -> None:
        super().__init__(template, width)
        self._distance = template.copy()
        self._buckets = np.zeros((3, first_capacity(template, width)), np.uint32)
        self._state = np.zeros(8, np.int64)

    def route(self, start: Cell, goal: Cell, hits: Hits) -> Route | None:
        """The route; None if the path may be longer than uint32 can count."""
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

    def _begin(self, source: np.uint64, target: np.uint64) -> None:  # noqa: ARG002 - it searches all ways
        self._state[:] = (STRAIGHT, 0, source, source, 0, 1, 0, 0)
        self._distance[source] = STRAIGHT
        self._buckets[0, 0] = source

    def _go_on(self, target: np.uint64) -> int:
        return flood(
            self._distance, self._buckets, self._state,
            width=self._width, goal=target, distance_max=DISTANCE_MAX,
        )  # fmt: skip

    def _grow(self) -> None:
        self._buckets = grown(self._buckets)

    def _answer(self, outcome: int, source: np.uint64, target: np.uint64) -> Route:
        expanded = int(self._state[1])
        if outcome != FOUND:
            return no_route("NO_VALID_PATH", expanded)
        path = np.empty(int(self._distance[target]) // STRAIGHT, np.uint64)  # no move is cheaper
        cells = _cells(path[: self._descend(path, source, target)], self._width)
        diagonal = int(np.abs(np.diff(cells, axis=0)).sum()) - (len(cells) - 1)
        return Route("NONE", cells, len(cells) - 1 - diagonal + diagonal * math.sqrt(2), expanded)

    def _descend(self, path: NDArray[np.uint64], source: np.uint64, target: np.uint64) -> int:
        return descend(self._distance, path, width=self._width, start=source, goal=target)

    def _reset(self) -> None:
        """Clear the distances, but only in the rows that the last search reached."""
        margin = int(self._width) + 1
        span = slice(int(self._state[2]) - margin, int(self._state[3]) + margin + 1)
        self._distance[span] = self._template[span]

    def _stamp(self, hits: Hits, *, blocked: bool) -> None:
        stamp(
            self._distance, self._template, self._width,
            rows=hits.rows, cols=hits.cols, reach=hits.reach, blocked=blocked,
        )  # fmt: skip


class WeightedWorkspace(Workspace):
    """For cells with costs, and for paths too long for uint32. Distances are float64: 0 is blocked.

    Infinity is free, and the start has the distance of one move.
    """

    def __init__(self, template: NDArray[np.uint32], width: int) -> None:
        super().__init__(template, width)
        self._distance = np.zeros(template.size, np.float64)
        self._costs = np.zeros(template.size, np.uint8)
        self._buckets = np.zeros((WHEEL, first_capacity(template, width)), np.uint32)
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
        length = descend_weighted(
            self._distance, self._costs, MOVES, path, width=self._width, start=source, goal=target
        )
        return Route("NONE", _cells(path[:length], self._width), cost, expanded)

    def _load(self, hits: Hits, costs: NDArray[np.uint8] | None) -> None:
        if costs is None:
            self._costs[:] = 0
        else:
            self._costs.reshape(-1, int(self._width))[1:-1, 1:-1] = costs
        load(self._distance, self._template, self._costs)
        stamp(
            self._distance, self._distance, self._width,
            rows=hits.rows, cols=hits.cols, reach=hits.reach, blocked=True,
        )  # fmt: skip

    def _begin(self, source: np.uint64, target: np.uint64) -> None:  # noqa: ARG002 - it searches all ways
        self._state[:2] = (1, 0)
        self._counts[:] = 0
        self._counts[1] = 1
        self._buckets[1, 0] = source
        self._distance[source] = 1.0

    def _go_on(self, target: np.uint64) -> int:
        return flood_weighted(
            self._distance, self._costs, MOVES, self._buckets,
            counts=self._counts, state=self._state, offsets=self._offsets, goal=target,
        )  # fmt: skip

    def _grow(self) -> None:
        self._buckets = grown(self._buckets)


def first_capacity(template: NDArray[np.uint32], width: int) -> int:
    """Room for a frontier of the map's circumference. A maze may need more; then the buckets grow."""
    return 16 * (template.size // width + width)


def grown(rows: NDArray[Any]) -> NDArray[Any]:
    """A copy with rows of twice the length."""
    copy = np.zeros((rows.shape[0], 2 * rows.shape[1]), rows.dtype)
    copy[:, : rows.shape[1]] = rows
    return copy


def _index(cell: Cell, width: np.uint64) -> np.uint64:
    """The index of a cell in the arrays, which have a border of one cell."""
    return np.uint64((cell[0] + 1) * int(width) + cell[1] + 1)


def _cells(path: NDArray[np.uint64], width: np.uint64) -> NDArray[np.int32]:
    """The cells (row, column) from start to goal of indices that begin at the goal."""
    rows, cols = np.divmod(path[::-1].astype(np.int64), int(width))
    return np.stack((rows - 1, cols - 1), axis=1).astype(np.int32)


def _status(distance: NDArray[Any], source: np.uint64, target: np.uint64) -> str:
    if distance[source] == 0:
        return "START_OCCUPIED"
    return "GOAL_OCCUPIED" if distance[target] == 0 else "NONE"
