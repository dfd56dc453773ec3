"""Small maps of every kind, and a planner in plain Python that finds the cost of the shortest path."""

import heapq
import lzma
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from offboard.common.planning import ASTAR, DIJKSTRA, JPS, planner, search
from offboard.common.planning.map_files import read_map
from offboard.common.planning.maps import GridMap

Cell = tuple[int, int]
SAMPLES = Path(__file__).parent / "samples"
BENCHMARKS = ("32room_000", "random512-10-0", "Berlin_1_1024")
# Planners without and with costs.
FORMS = ((DIJKSTRA, False), (DIJKSTRA, True), (ASTAR, False), (ASTAR, True), (JPS, False))
FACTORS = [(50 + 0.8 * cost) / 50 for cost in range(253)]


def warm() -> None:
    """Compile all planners."""
    planner.warm()
    for name, weighted in FORMS:
        costs = np.zeros((3, 3), np.uint8) if weighted else None
        search.Field(np.ones((3, 3), np.bool_)).route((0, 0), (2, 2), costs=costs, planner=name)


def benchmark(name: str, folder: Path) -> tuple[GridMap, list[tuple[Cell, Cell, float]]]:
    """A map of MovingAI, and problems on it: start, goal, and the published length of the shortest path."""
    path = folder / f"{name}.map"
    path.write_bytes(lzma.decompress((SAMPLES / f"{name}.map.xz").read_bytes()))
    problems = []
    for line in lzma.decompress((SAMPLES / f"{name}.scen.xz").read_bytes()).decode().splitlines()[1:]:
        *_, x, y, goal_x, goal_y, optimum = line.split()
        problems.append(((int(y), int(x)), (int(goal_y), int(goal_x)), float(optimum)))
    return read_map(path), problems


def oracle(
    free: NDArray[np.bool_], start: Cell, goal: Cell, costs: NDArray[np.uint8] | None = None
) -> float | None:
    """Textbook Dijkstra with a heap, in plain Python; None if there is no path."""
    open_: Any = free.tolist()
    height, width = free.shape
    weights: Any = (np.zeros(free.shape, np.uint8) if costs is None else costs).tolist()
    best, heap = {start: 0.0}, [(0.0, start)]
    while heap:
        done, (row, col) = heapq.heappop(heap)
        if (row, col) == goal:
            return done
        if done > best[row, col]:
            continue
        for dr in (-1, 0, 1):
            for dc in (-1, 0, 1):
                r, c = row + dr, col + dc
                if not (0 <= r < height and 0 <= c < width and open_[r][c]):
                    continue
                if dr and dc and not (open_[row][c] and open_[r][col]):
                    continue
                length = done + math.hypot(dr, dc) * FACTORS[weights[r][c]]
                if length < best.get((r, c), math.inf):
                    best[r, c] = length
                    heapq.heappush(heap, (length, (r, c)))
    return None


def path_cost(
    free: NDArray[np.bool_], cells: NDArray[np.int32], costs: NDArray[np.uint8] | None = None
) -> float:
    """The cost of a path; fails if a move is not allowed."""
    total = 0.0
    for (row, col), (r, c) in zip(cells.tolist(), cells[1:].tolist(), strict=False):
        assert max(abs(r - row), abs(c - col)) == 1
        assert free[r, c]
        assert free[row, c]
        assert free[r, col]
        total += math.hypot(r - row, c - col) * FACTORS[0 if costs is None else costs[r, c]]
    return total


def check(
    free: NDArray[np.bool_], start: Cell, goal: Cell, route: search.Route, expected: float | None,
    costs: NDArray[np.uint8] | None = None,
) -> None:  # fmt: skip
    if expected is None:
        assert (route.status, len(route.cells)) == ("NO_VALID_PATH", 0)
        return
    assert route.status == "NONE"
    assert route.cost == pytest.approx(expected, rel=1e-9, abs=1e-9)
    assert (tuple(route.cells[0]), tuple(route.cells[-1])) == (start, goal)
    assert path_cost(free, route.cells, costs) == pytest.approx(expected, rel=1e-9, abs=1e-9)


def random_maze(rng: np.random.Generator) -> NDArray[np.bool_]:
    """A small map: noise of any density, corridors one cell wide, or a single row or column."""
    height, width = rng.integers(1, 13, 2)
    free = rng.random((height, width)) > rng.choice([0.0, 0.2, 0.35, 0.5])
    if rng.random() < 0.3:
        free[1::2, rng.random(width) > 0.25] = False
    return np.asarray(free)


def random_cells(rng: np.random.Generator, free: NDArray[np.bool_]) -> tuple[Cell, Cell]:
    choice = rng.choice(np.argwhere(free), 2)
    return (int(choice[0][0]), int(choice[0][1])), (int(choice[1][0]), int(choice[1][1]))


def serpentine(side: int) -> NDArray[np.bool_]:
    """One folded corridor of about side * side / 2 cells."""
    free = np.zeros((side, side), np.bool_)
    free[::2] = True
    free[1::4, -1] = True
    free[3::4, 0] = True
    return free
