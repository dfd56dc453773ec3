"""The time of one shortest path from corner to corner, compared to packages that pip can install."""

import concurrent.futures
import dataclasses
import functools
import math
import multiprocessing
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.measure import Requirement, Table, interleaved
from offboard.common.planning import ASTAR, JPS, planner
from offboard.common.planning.grid_kernels import largest_component
from offboard.common.planning.map_files import read_map
from offboard.common.planning.maps import GridMap, free_pairs, passable
from offboard.common.planning.planner import Point, Pose, Scan
from offboard.common.planning.search import Cell, Field, Route

ROOT = Path(__file__).parents[1]
BERLIN = ROOT.parent / "shared/maps/movingai/Berlin_1_1024.map"
SIDE = 4000
BLOCKS, BLOCK = 1500, 60  # rectangles on a map with this side, and the longest side of a rectangle
SIDES = (400, 1000, 2000, SIDE)
ROUNDS = 9
BEAMS, SCAN_M = 360, 3.5
PAIRS = 40
# The directions (row, column) in the graphs of dijkstra3d, and their bits.
BITS = {(1, 0): 0, (-1, 0): 1, (0, 1): 2, (0, -1): 3, (1, 1): 6, (-1, 1): 7, (1, -1): 8, (-1, -1): 9}

Free = NDArray[np.bool_]


def tables() -> list[Table]:
    planner.warm()
    found, maps = [], _maps()
    for name, free in maps.items():
        found.append(_against_peers(name, free, 10.0 if name.startswith("Berlin") else 8.0))
    found.append(_of_one_map(maps["Willow Garage"]))
    if len(maps) < 3:
        found[-1] = dataclasses.replace(found[-1], missing=[f"{BERLIN.name}: the file is missing"])
    return [*found, _growth()]


def _maps() -> dict[str, Free]:
    """For each map, the passable cells that can all be reached from each other."""
    found = {} if not BERLIN.exists() else {"Berlin_1_1024": passable(read_map(BERLIN))}
    found["Willow Garage"] = passable(read_map(ROOT / "maps/willow-full-0.05.yaml"))
    found[f"{SIDE} x {SIDE}, generated"] = _generated(SIDE)
    return {name: largest_component(free) for name, free in found.items()}


def _generated(side: int) -> Free:
    """A free map with random rectangles; the number of rectangles per area does not depend on the side."""
    random, blocks = np.random.default_rng(1), BLOCKS * side**2 // SIDE**2
    free = np.ones((side, side), np.bool_)
    for row, col, height, width in zip(
        *random.integers(0, side, (2, blocks)), *random.integers(1, BLOCK, (2, blocks)), strict=True
    ):
        free[row : row + height, col : col + width] = False
    return free


def _corners(free: Free) -> tuple[Cell, Cell]:
    cells = np.argwhere(free)
    total = cells.sum(1)
    first, last = cells[total.argmin()], cells[total.argmax()]
    return (int(first[0]), int(first[1])), (int(last[0]), int(last[1]))


def _against_peers(name: str, free: Free, times: float) -> Table:
    import dijkstra3d
    import pyastar2d
    from skimage.graph import MCP_Geometric

    start, goal = _corners(free)
    field = Field(free)
    allowed, columns = _allowed(free), np.asfortranarray(free)
    weights = np.where(free, np.float32(1), np.float32(np.inf))
    costs = np.where(free, 1.0, -1.0)

    def exact() -> NDArray[np.int64]:
        path: NDArray[np.int64] = dijkstra3d.binary_dijkstra(
            columns, start, goal, connectivity=8, background_color=0, voxel_graph=allowed
        )
        return path

    route, peer = field.route(start, goal), _length(exact())
    if not math.isclose(route.cost, peer, rel_tol=1e-6):
        raise AssertionError(f"{name}: our path costs {route.cost}, the path of dijkstra3d {peer}")
    for planner_name in (ASTAR, JPS):
        if (cost := field.route(start, goal, planner=planner_name).cost) != route.cost:
            raise AssertionError(f"{name}: the path of {planner_name} costs {cost}, not {route.cost}")
    peers: dict[str, Callable[[], object]] = {
        "offboard": lambda: field.route(start, goal),
        "offboard, astar": lambda: field.route(start, goal, planner=ASTAR),
        "offboard, jps": lambda: field.route(start, goal, planner=JPS),
        "dijkstra3d": exact,
        "pyastar2d (A*)": lambda: pyastar2d.astar_path(weights, start, goal, allow_diagonal=True),
    }
    seconds = interleaved(peers, ROUNDS)
    seconds["scikit-image MCP (cuts corners)"] = interleaved(
        {"": lambda: MCP_Geometric(costs, fully_connected=True).find_costs([start], [goal])}, 1
    )[""]
    ours = seconds["offboard"]
    rows = [[peer, f"{each * 1e3:.1f}", f"{each / ours:.2f}"] for peer, each in seconds.items()]
    title = f"Planner: {name}, corner to corner, {route.expanded} cells expanded, cost {route.cost:.3f}"
    requirements = [
        Requirement("dijkstra3d, relative to offboard", seconds["dijkstra3d"] / ours, times, at_least=True),
        Requirement(
            "offboard, relative to offboard with jps", ours / seconds["offboard, jps"], 2.0, at_least=True
        ),
    ]
    return Table(title, ("planner", "ms", "relative to offboard"), rows, requirements)


def _growth() -> Table:
    """The paper assumes that the time of a plan is proportional to n ln n."""
    routes: dict[str, Callable[[], Route]] = {}
    for side in SIDES:
        free = largest_component(_generated(side))
        routes[f"{side} x {side}"] = functools.partial(Field(free).route, *_corners(free))
    cells = {name: route().expanded for name, route in routes.items()}
    seconds = interleaved(routes, ROUNDS)
    ns = {name: each / (cells[name] * math.log(cells[name])) * 1e9 for name, each in seconds.items()}
    rows = [
        [name, str(cells[name]), f"{seconds[name] * 1e3:.2f}", f"{each:.3f}"] for name, each in ns.items()
    ]
    # The distances take 0.6 MB on the smallest map, which fits the cache of a core, and 64 MB on the largest.
    requirement = Requirement("highest / lowest ns per n ln n", max(ns.values()) / min(ns.values()), 3.0)
    title = "Planner: time by map size, corner to corner of generated maps, n cells expanded"
    return Table(title, ("map", "n", "ms", "ns per n ln n"), rows, [requirement])


def _of_one_map(free: Free) -> Table:
    start, goal = _corners(free)
    field = Field(free)
    grid = GridMap(np.where(free, 0, 100).astype(np.int8), 0.05)
    pose = Pose((start[1] + 0.5) * 0.05, (start[0] + 0.5) * 0.05)
    beams = np.full(BEAMS, SCAN_M - 0.5, np.float32)
    scan = Scan(beams, -math.pi, 2 * math.pi / BEAMS, SCAN_M)
    hits = planner.scan_hits(grid, scan, pose, 0.2)
    zeros = np.zeros(free.shape, np.uint8)
    same = Point(pose.x, pose.y)
    there = grid.cell(same.x, same.y) or start
    seconds = interleaved(
        {
            "a search": lambda: field.route(start, goal),
            "preparing the map": lambda: Field(free).route(start, start),
            "a search with costs, all 0": lambda: field.route(start, goal, costs=zeros),
            "start = goal": lambda: field.route(start, there),
            "start = goal, with a scan": lambda: field.route(start, there, hits),
        },
        ROUNDS,
    )
    search = seconds["a search"]
    rows = [[name, f"{each * 1e3:.3f}", f"{each / search:.2f}"] for name, each in seconds.items()]
    overlay_ms = seconds["start = goal, with a scan"] * 1e3
    share, allocated = _two_threads(free), _allocated(field, start, goal)
    requirements = [
        Requirement("preparing a map, relative to a search", seconds["preparing the map"] / search, 2.0),
        Requirement(f"start = goal, with a scan of {BEAMS} beams", overlay_ms, 0.3, "ms"),
        Requirement(
            "a search with costs, relative to one without",
            seconds["a search with costs, all 0"] / search,
            3.0,
        ),
        Requirement("bytes that a search allocates per cell of the map", allocated / free.size, 0.1),
        Requirement("searches per second, two threads relative to two processes", share, 0.85, at_least=True),
    ]
    return Table(
        "Planner: Willow Garage, one map", ("step", "ms", "relative to a search"), rows, requirements
    )


def _allocated(field: Field, start: Cell, goal: Cell) -> int:
    """The highest number of bytes that a search allocates; the first search is not counted."""
    field.route(start, goal)
    tracemalloc.start()
    field.route(start, goal)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return peak


def _two_threads(free: Free) -> float:
    """Searches per second of two threads, relative to two processes; the median of several rounds."""
    grid = GridMap(np.where(free, 0, 100).astype(np.int8), 0.05)
    pairs = [(tuple(start), tuple(goal)) for start, goal in free_pairs(grid, PAIRS, seed=1).tolist()]
    context = multiprocessing.get_context("spawn")
    ratios = []
    with (
        concurrent.futures.ThreadPoolExecutor(2) as threads,
        concurrent.futures.ProcessPoolExecutor(2, context, _start_worker, (free,)) as processes,
    ):
        _start_worker(free)
        for pool in (threads, processes):
            list(pool.map(_search, pairs))
        for _ in range(ROUNDS):
            took = []
            for pool in (threads, processes):
                began = time.perf_counter()
                list(pool.map(_search, pairs))
                took.append(time.perf_counter() - began)
            ratios.append(took[1] / took[0])
    return float(np.median(ratios))


_field: Field


def _start_worker(free: Free) -> None:
    global _field
    _field = Field(free)


def _search(pair: tuple[Cell, Cell]) -> float:
    return _field.route(*pair).cost


def _allowed(free: Free) -> NDArray[np.uint32]:
    """The moves that our planner allows, as a graph of dijkstra3d: no corner is cut."""
    framed = np.pad(free, 1)
    height, width = free.shape
    allowed = np.zeros(free.shape, np.uint32, order="F")

    def seen(row: int, col: int) -> Free:
        return framed[1 + row : 1 + row + height, 1 + col : 1 + col + width]

    for (row, col), bit in BITS.items():
        open_ = free & seen(row, col) & seen(row, 0) & seen(0, col)
        allowed |= open_.astype(np.uint32) << np.uint32(bit)
    return allowed


def _length(path: NDArray[np.int64]) -> float:
    moves = np.abs(np.diff(path[:, :2].astype(np.int64), axis=0)).sum(1)
    return float((moves == 1).sum() + (moves == 2).sum() * math.sqrt(2))
