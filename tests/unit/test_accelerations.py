"""A* and jump point search find exactly the costs of Dijkstra with less work."""

import itertools
import math
import threading
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from offboard.common.errors import Unwanted
from offboard.common.planning import ASTAR, DIJKSTRA, JPS, PLANNERS, jump_points, maps, search, workspaces
from offboard.common.planning.dijkstra import PAUSE_CELLS
from offboard.common.planning.map_files import read_map
from offboard.common.planning.planner import Point, Pose, Scan, plan_path
from offboard.common.planning.search import NO_HITS, Cell, Field, Hits, Route
from offboard.common.task_call import call_while
from tests.mazes import (
    BENCHMARKS,
    FORMS,
    benchmark,
    check,
    oracle,
    path_cost,
    random_cells,
    random_maze,
    serpentine,
    warm,
)

ROOT = Path(__file__).parents[2]
WILLOW = ROOT / "maps/willow-full-0.05.yaml"
QUICK = (ASTAR, JPS)
warm()  # compile now, so that the timeout of no test includes it


def noise(height: int, width: int, blocked: float) -> NDArray[np.bool_]:
    free = np.random.default_rng(1).random((height, width)) > blocked
    free[0, 0] = free[-1, -1] = True
    return free


def same(one: Route, other: Route) -> bool:
    return (one.status, one.cost, len(one.cells)) == (other.status, other.cost, len(other.cells))


def test_two_thousand_small_mazes_match_a_plain_planner() -> None:
    """Every planner finds exactly the cost of Dijkstra, and cost and path are those of a plain planner.

    The mazes include problems without a path, with start = goal, at the border, and in narrow corridors.
    """
    rng = np.random.default_rng(12)
    unreachable = standing = border = thin = 0
    for _ in range(2_000):
        free = random_maze(rng)
        if not free.any():
            continue
        start, goal = random_cells(rng, free)
        field, expected = Field(free), oracle(free, start, goal)
        level = field.route(start, goal)
        for planner in QUICK:
            route = field.route(start, goal, planner=planner)
            check(free, start, goal, route, expected)
            assert same(route, level)
        unreachable += expected is None
        standing += start == goal
        border += 0 in (*start, *goal)
        thin += 1 in free.shape
    assert min(unreachable, standing, border, thin) > 50, (unreachable, standing, border, thin)


def test_two_thousand_weighted_mazes_match_a_plain_planner() -> None:
    """With costs, A* finds exactly the cost of Dijkstra, and cost and path are those of a plain planner."""
    rng = np.random.default_rng(13)
    for _ in range(2_000):
        free = random_maze(rng)
        if not free.any():
            continue
        start, goal = random_cells(rng, free)
        costs = np.where(free, rng.integers(0, rng.choice([2, 253]), free.shape), 255).astype(np.uint8)
        field = Field(np.ones_like(free))
        route = field.route(start, goal, costs=costs, planner=ASTAR)
        check(free, start, goal, route, oracle(free, start, goal, costs), costs)
        level = field.route(start, goal, costs=costs)
        assert (route.status, route.cost) == (level.status, level.cost)


def test_large_rooms_match_dijkstra() -> None:
    """Costs are equal, also on lines longer than a word of 64 bits and diagonals longer than a stride."""
    rng = np.random.default_rng(14)
    for blocked in (0.0, 0.0005, 0.003, 0.02, 0.1, 0.3):
        free = np.asarray(rng.random((180, 330)) > blocked)
        free[100, :300] = False
        field = Field(free)
        for _ in range(20):
            start, goal = random_cells(rng, free)
            level = field.route(start, goal)
            for planner in QUICK:
                route = field.route(start, goal, planner=planner)
                assert same(route, level), (blocked, planner, start, goal)
                assert path_cost(free, route.cells) == pytest.approx(level.cost, rel=1e-9)


@pytest.mark.parametrize("name", BENCHMARKS)
def test_published_optima(tmp_path: Path, name: str) -> None:
    """100 problems of each benchmark map have the published length within 1e-3."""
    grid, problems = benchmark(name, tmp_path)
    field = Field(maps.passable(grid))
    for start, goal, optimum in problems[::3]:
        for planner in QUICK:
            route = field.route(start, goal, planner=planner)
            assert route.cost == pytest.approx(optimum, abs=1e-3), (planner, start, goal)


@pytest.mark.parametrize("name", ["willow-full-0.05", "depot"])
def test_on_real_maps_a_star_expands_no_more_than_dijkstra(name: str) -> None:
    """In 60 problems A* never expands more cells, and less than half in total; the costs are equal."""
    grid = read_map(ROOT / f"maps/{name}.yaml")
    field = Field(maps.passable(grid))
    total = dict.fromkeys(PLANNERS, 0)
    for start, goal in maps.free_pairs(grid, 60, seed=4).tolist():
        routes = {planner: field.route(start, goal, planner=planner) for planner in PLANNERS}
        assert len({route.cost for route in routes.values()}) == 1, (start, goal)
        assert routes[ASTAR].expanded <= routes[DIJKSTRA].expanded, (start, goal)
        for planner, route in routes.items():
            total[planner] += route.expanded
    print(total)
    assert total[JPS] < total[ASTAR] < total[DIJKSTRA] / 2


FREE: dict[str, Callable[[], NDArray[np.bool_]]] = {
    "room": lambda: np.ones((300, 400), np.bool_),
    "noise": lambda: noise(300, 400, 0.1),
    "willow": lambda: maps.largest_component(maps.passable(read_map(WILLOW))),
}


# Expanded cells or jump points when this was written, plus a tenth for a different order.
@pytest.mark.parametrize(
    ("place", "planner", "expanded_max"),
    [
        ("room", DIJKSTRA, 120_000),
        ("room", ASTAR, 399),
        ("room", JPS, 6),
        ("noise", DIJKSTRA, 119_000),
        ("noise", ASTAR, 23_300),
        ("noise", JPS, 5_140),
        ("willow", DIJKSTRA, 600_000),
        ("willow", ASTAR, 223_000),
        ("willow", JPS, 3_240),
    ],
)
def test_fixed_problems_do_not_take_more_work(place: str, planner: str, expanded_max: int) -> None:
    """A search from corner to corner expands no more cells than it did before."""
    free = FREE[place]()
    cells = np.argwhere(free)
    start, goal = (tuple(cells[n].tolist()) for n in (cells.sum(1).argmin(), cells.sum(1).argmax()))
    assert 0 < Field(free).route(start, goal, planner=planner).expanded <= expanded_max


@pytest.mark.parametrize(("planner", "weighted"), FORMS)
def test_a_second_search_allocates_little_memory(planner: str, weighted: bool) -> None:
    """It allocates memory for the path only, far below one byte per cell of the map."""
    field, costs = Field(noise(1000, 1000, 0.02)), np.zeros((1000, 1000), np.uint8) if weighted else None
    field.route((0, 0), (999, 999), costs=costs, planner=planner)
    tracemalloc.start()
    field.route((0, 0), (999, 999), costs=costs, planner=planner)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 250_000


@pytest.mark.parametrize("planner", QUICK)
def test_hits_block_their_discs_for_one_request_only(planner: str) -> None:
    """A route avoids the disc of a hit, also across the border, and the next request is not affected."""
    free = noise(41, 70, 0.05)
    free[20, 0] = free[20, 69] = True
    field = Field(free)
    rng = np.random.default_rng(5)
    before = field.route((20, 0), (20, 69), planner=planner)
    for _ in range(30):
        hits = Hits(rng.integers(-3, 44, 5), rng.integers(5, 65, 5), rng.uniform(0, 4.5, 5))
        world = free.copy()
        for row, col in np.ndindex(free.shape):
            world[row, col] &= (np.hypot(row - hits.rows, col - hits.cols) > hits.reach).all()
        route = field.route((20, 0), (20, 69), hits, planner=planner)
        check(world, (20, 0), (20, 69), route, oracle(world, (20, 0), (20, 69)))
        assert same(route, field.route((20, 0), (20, 69), hits))
        level = np.zeros(free.shape, np.uint8)
        weighted = field.route((20, 0), (20, 69), hits, level, planner=ASTAR)
        assert weighted.cost == pytest.approx(route.cost, rel=1e-9)
        again = field.route((20, 0), (20, 69), planner=planner)
        assert again.cells.tolist() == before.cells.tolist()
    outside = Hits(np.array([20]), np.array([69]), np.array([1.0]))
    assert field.route((20, 0), (20, 69), outside, planner=planner).status == "GOAL_OCCUPIED"
    assert field.route((20, 69), (20, 0), outside, planner=planner).status == "START_OCCUPIED"


@pytest.mark.parametrize("planner", QUICK)
def test_a_path_too_long_for_uint32_is_exact(planner: str) -> None:
    """For more than 53,166 cells the float64 search is used, in a long corridor and on a long map."""
    free = serpentine(331)
    moves = int(free.sum()) - 1
    assert moves > 53_166
    for first, length in ((0, moves), (12, int(free[12:].sum()) - 1)):
        route = Field(free).route((first, 0), (330, 0), planner=planner)
        assert (route.status, route.cost, len(route.cells)) == ("NONE", length, length + 1)
    field, at_12 = Field(free), int(free[12:].sum()) - 1
    for moves in range(53_160, 53_170):  # around the limit; row 10 is crossed backwards
        start = (12, at_12 - moves) if moves <= at_12 else (10, moves - at_12 - 2)
        route = field.route(start, (330, 0), planner=planner)
        assert (route.status, route.cost) == ("NONE", moves), start
    side = Field(np.ones((2, 60_000), np.bool_)).route((0, 0), (1, 59_999), planner=planner)
    assert (side.status, side.cost) == ("NONE", pytest.approx(59_998 + math.sqrt(2)))


@pytest.mark.parametrize("planner", QUICK)
def test_arrays_grow_when_they_are_full(monkeypatch: pytest.MonkeyPatch, planner: str) -> None:
    """A search that starts with tiny arrays finds the same route with the same work."""
    free = noise(200, 200, 0.1)
    first = Field(free).route((0, 0), (199, 199), planner=planner)
    for module in (workspaces, search):
        monkeypatch.setattr(module, "first_capacity", lambda *_: 8)
    monkeypatch.setattr(jump_points, "NODES_MAX", 4)
    again = Field(free).route((0, 0), (199, 199), planner=planner)
    assert again.expanded == first.expanded
    assert again.cells.tolist() == first.cells.tolist()


def test_threads_on_one_map_do_not_disturb_each_other() -> None:
    """Four threads with all planners, costs and hits get the routes that one thread gets alone."""
    grid = read_map(ROOT / "tests/samples/random512-10-0-crop.map")
    field = Field(maps.passable(grid))
    costs = np.random.default_rng(0).integers(0, 253, grid.cells.shape).astype(np.uint8)
    hits = Hits(np.arange(10, 120, 7), np.full(16, 64), np.full(16, 2.0))
    pairs = maps.free_pairs(grid, 60, seed=9).tolist()

    def answers() -> list[tuple[str, float, list[list[int]]]]:
        routes = []
        for n, (start, goal) in enumerate(pairs):
            seen = hits if n % 2 else NO_HITS
            routes.append(field.route(start, goal, seen, planner=PLANNERS[n % 3]))
            routes.append(field.route(start, goal, seen, costs, planner=PLANNERS[n % 2]))
        return [(route.status, route.cost, route.cells.tolist()) for route in routes]

    alone = answers()
    together: list[object] = []
    threads = [threading.Thread(target=lambda: together.append(answers())) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert together == [alone] * 4


@pytest.mark.parametrize(("planner", "weighted"), FORMS[2:])
def test_a_search_stops_if_nobody_waits_for_it(planner: str, weighted: bool) -> None:
    """It checks at least every PAUSE_CELLS cells or looks, and the next search is correct."""
    free = noise(1000, 1000, 0.3)
    free[989], free[990:] = False, True
    field, costs = Field(free), np.zeros(free.shape, np.uint8) if weighted else None
    looks = itertools.count()

    def route(goal: Cell = (999, 999)) -> Route:
        return field.route((0, 0), goal, NO_HITS, costs, planner)

    whole = call_while(lambda: next(looks) >= 0, route, ())
    assert whole.status == "NO_VALID_PATH"
    assert next(looks) >= (3 if planner == JPS else whole.expanded // PAUSE_CELLS)
    with pytest.raises(Unwanted):
        call_while(lambda: False, route, ())
    near = (int(np.flatnonzero(free[:100, 5])[-1]), 5)
    assert route(near).cost == pytest.approx(field.route((0, 0), near).cost, rel=1e-9)


def test_unknown_planners_and_costs_with_jps_are_refused() -> None:
    """The error is one line with the argument and what is allowed."""
    grid, costs = maps.GridMap(np.zeros((9, 9), np.int8), 1.0), np.zeros((9, 9), np.uint8)
    pose, goal = Pose(0.5, 0.5), Point(8.5, 8.5)
    with pytest.raises(ValueError, match=r"^planner is 'theta', allowed are dijkstra, astar, jps$"):
        plan_path(grid, None, pose, goal, 0.0, None, "theta")
    refused = r"^costs are not allowed with planner 'jps', only with dijkstra and astar$"
    with pytest.raises(ValueError, match=refused):
        plan_path(grid, None, pose, goal, 0.0, costs, JPS)
    with pytest.raises(ValueError, match=refused):
        Field(np.ones((9, 9), np.bool_)).route((0, 0), (8, 8), costs=costs, planner=JPS)


@pytest.mark.parametrize("planner", QUICK)
def test_all_planners_find_the_same_plan_with_a_scan(planner: str) -> None:
    """The task adds the scan to the map whichever planner it uses."""
    willow = read_map(WILLOW)
    pairs = willow.metres(maps.free_pairs(willow, 12, seed=3, radius_m=0.2).reshape(-1, 2)).reshape(-1, 2, 2)
    for n, ((x, y), (goal_x, goal_y)) in enumerate(pairs.tolist()):
        scan = Scan(np.full(90, 0.5 + 0.2 * n, np.float32), 0.0, math.pi / 45, 10.0)
        plans = [
            plan_path(willow, scan, Pose(x, y), Point(goal_x, goal_y), 0.2, None, name)
            for name in (DIJKSTRA, planner)
        ]
        assert len({(plan.status, plan.cost) for plan in plans}) == 1
