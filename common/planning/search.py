"""Exact shortest paths on a prepared map, by three planners, for many threads at once.

Moves go to the 8 neighbours; they cost 1 or sqrt 2 times the factor of the entered cell, and never cut a
corner. `planner` decides which cells are blocked.
"""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from offboard.common.planning.informed_workspaces import (
    FREE,
    AStarPlainWorkspace,
    AStarWeightedWorkspace,
    JumpWorkspace,
)
from offboard.common.planning.planner_names import ASTAR, DIJKSTRA, JPS, check_planner
from offboard.common.planning.route import NO_HITS, Cell, Hits, Route, no_route
from offboard.common.planning.workspaces import PlainWorkspace, WeightedWorkspace

__all__ = ["NO_HITS", "Cell", "Field", "Hits", "Route", "no_route"]

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

    def __len__(self) -> int:
        """The number of idle workspaces."""
        return len(self._idle)

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
