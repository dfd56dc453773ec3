"""Dijkstra's search, compared with a planner in plain Python and with the published optima of MovingAI."""

import itertools
import math
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from offboard.common.errors import Unwanted
from offboard.common.planning import maps, planner, search, workspaces
from offboard.common.planning.dijkstra import DISTANCE_MAX, PAUSE_CELLS, STRAIGHT
from offboard.common.planning.map_files import read_map
from offboard.common.planning.search import Field, Hits
from offboard.common.task_call import call_while
from tests.mazes import BENCHMARKS, benchmark, check, oracle, random_cells, random_maze, serpentine

ROOT = Path(__file__).parents[2]
SAMPLES = ROOT / "tests/samples"
planner.warm()  # compile now, so that the timeout of no test includes it


def test_two_thousand_small_mazes_match_a_plain_planner() -> None:
    """Cost, path and reachability are those of textbook Dijkstra, with and without costs."""
    rng = np.random.default_rng(11)
    unreachable = same = 0
    for n in range(2_000):
        free = random_maze(rng)
        if not free.any():
            continue
        start, goal = random_cells(rng, free)
        costs = None
        if n % 2:
            costs = np.where(free, rng.integers(0, 253, free.shape), 255).astype(np.uint8)
            costs[start] = min(costs[start], 252)
        expected = oracle(free, start, goal, costs)
        blocked_by_cost = np.ones_like(free) if costs is not None else free
        check(free, start, goal, Field(blocked_by_cost).route(start, goal, costs=costs), expected, costs)
        unreachable += expected is None
        same += start == goal
    assert unreachable > 100
    assert same > 10


def test_a_corner_is_never_cut() -> None:
    """Two free cells that touch only at a corner are connected only through a free cell beside both."""
    crossed = np.array([[1, 0], [0, 1]], np.bool_)
    half = np.array([[1, 1], [0, 1]], np.bool_)
    assert Field(crossed).route((0, 0), (1, 1)).status == "NO_VALID_PATH"
    assert Field(half).route((0, 0), (1, 1)).cost == 2.0
    assert Field(np.ones((2, 2), np.bool_)).route((0, 0), (1, 1)).cost == math.sqrt(2)


def test_the_search_stops_at_the_goal() -> None:
    """If the goal is near, few cells of a large map are settled; if the goal is the start, none."""
    field = Field(np.ones((400, 400), np.bool_))
    assert field.route((200, 200), (200, 210)).expanded < 4 * 11**2
    here = field.route((7, 7), (7, 7))
    assert (here.status, here.cost, here.expanded, here.cells.tolist()) == ("NONE", 0.0, 0, [[7, 7]])


def test_a_path_too_long_for_uint32_is_exact() -> None:
    """For more than 53,166 cells the float64 search is used, and the length of the corridor is exact."""
    free = serpentine(331)
    end = (330, 330 if (330 // 2) % 2 == 0 else 0)
    moves = int(free.sum()) - 1
    assert moves > 53_166
    route = Field(free).route((0, 0), end)
    assert (route.status, route.cost, len(route.cells)) == ("NONE", moves, moves + 1)


def test_the_longest_path_for_uint32_is_exact() -> None:
    """Just below the limit no distance overflows."""
    free = serpentine(331)
    end = (330, 330 if (330 // 2) % 2 == 0 else 0)
    moves = int(free[12:].sum()) - 1
    assert 0 < DISTANCE_MAX / STRAIGHT - moves < 50
    assert Field(free).route((12, 0), end).cost == moves


@pytest.mark.parametrize("name", ["random512-10-0-crop", "32room_000-crop"])
def test_both_kernels_find_the_same_costs(name: str) -> None:
    """On real maps the float64 search finds the costs of the uint32 search, with about the same work."""
    grid = read_map(SAMPLES / f"{name}.map")
    field, level = Field(maps.passable(grid)), np.zeros(grid.cells.shape, np.uint8)
    for start, goal in maps.free_pairs(grid, 100, seed=2).tolist():
        plain, weighted = field.route(start, goal), field.route(start, goal, costs=level)
        assert plain.cost == pytest.approx(weighted.cost, rel=1e-9)
        assert abs(plain.expanded - weighted.expanded) <= plain.expanded * 0.05 + 50


@pytest.mark.parametrize("name", ["random512-10-0-crop", "32room_000-crop"])
def test_crops_of_the_benchmarks_match_a_plain_planner(name: str) -> None:
    """On the sample maps of the repository every cost is that of an independent planner."""
    grid = read_map(SAMPLES / f"{name}.map")
    free = grid.cells == 0
    field = Field(free)
    rng = np.random.default_rng(8)
    costs = rng.integers(0, 253, free.shape).astype(np.uint8)
    for n in range(24):
        start, goal = random_cells(rng, free)
        weights = costs if n % 3 == 0 else None
        expected = oracle(free, start, goal, weights)
        check(free, start, goal, field.route(start, goal, costs=weights), expected, weights)


@pytest.mark.parametrize("part", [0, 1, 2])
@pytest.mark.parametrize("name", BENCHMARKS)
def test_published_optima(tmp_path: Path, name: str, part: int) -> None:
    """300 problems of each benchmark map have the published length within 1e-3."""
    grid, problems = benchmark(name, tmp_path)
    field = Field(maps.passable(grid))
    assert len(problems) == 300
    for start, goal, optimum in problems[part::3]:
        assert field.route(start, goal).cost == pytest.approx(optimum, abs=1e-3), (start, goal)


def test_hits_block_their_discs_for_one_request_only() -> None:
    """A route avoids the disc of a hit, and the next request is not affected."""
    free = np.ones((41, 41), np.bool_)
    field = Field(free)
    rng = np.random.default_rng(5)
    before = field.route((20, 0), (20, 40))
    for _ in range(20):
        rows, cols = rng.integers(5, 36, (2, 3))
        hits = Hits(rows, cols, rng.uniform(0, 4.5, 3))
        world = free.copy()
        for row, col in np.ndindex(free.shape):
            world[row, col] = (np.hypot(row - rows, col - cols) > hits.reach).all()
        route = field.route((20, 0), (20, 40), hits)
        check(world, (20, 0), (20, 40), route, oracle(world, (20, 0), (20, 40)))
        weighted = field.route((20, 0), (20, 40), hits, np.zeros(free.shape, np.uint8))
        assert weighted.cost == pytest.approx(route.cost, rel=1e-9)
        again = field.route((20, 0), (20, 40))
        assert again.cells.tolist() == before.cells.tolist()


def test_hits_at_the_border_stay_on_the_map() -> None:
    """Discs across the border and hits outside the map block no other cells."""
    field = Field(np.ones((9, 9), np.bool_))
    outside = Hits(np.array([-3, 12, 4, 0]), np.array([4, 4, -50, 8]), np.array([1.0, 1.0, 2.0, 3.0]))
    assert field.route((8, 0), (4, 4), outside).status == "NONE"
    assert field.route((8, 0), (0, 8), outside).status == "GOAL_OCCUPIED"
    assert field.route((0, 8), (8, 0), outside).status == "START_OCCUPIED"
    assert field.route((0, 8), (8, 0)).cost == pytest.approx(8 * math.sqrt(2))


def test_buckets_grow_when_they_are_full(monkeypatch: pytest.MonkeyPatch) -> None:
    """A search that starts with tiny buckets finds the same route with the same work."""
    free = np.random.default_rng(1).random((200, 200)) > 0.1
    free[0, 0] = free[199, 199] = True
    costs = np.full(free.shape, 30, np.uint8)
    wide = [Field(free).route((0, 0), (199, 199), costs=weights) for weights in (None, costs)]
    monkeypatch.setattr(workspaces, "first_capacity", lambda *_: 8)
    small = [Field(free).route((0, 0), (199, 199), costs=weights) for weights in (None, costs)]
    for one, other in zip(wide, small, strict=True):
        assert (one.cost, one.expanded) == (other.cost, other.expanded)
        assert one.cells.tolist() == other.cells.tolist()


def test_later_requests_allocate_little_memory() -> None:
    """After the first request of each kind, another one allocates far less than one byte per cell."""
    field = Field(np.ones((1000, 1000), np.bool_))
    costs = np.zeros((1000, 1000), np.uint8)
    for weights in (None, costs):
        field.route((0, 0), (999, 999), costs=weights)
    tracemalloc.start()
    for weights in (None, costs):
        for _ in range(3):
            field.route((0, 0), (999, 999), costs=weights)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 200_000


def test_idle_workspaces_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """At most IDLE_MAX workspaces are kept, and none whose search failed."""
    monkeypatch.setattr(search, "IDLE_MAX", 2)
    pool = search.Pool(object)
    borrowed = [pool.borrow() for _ in range(5)]
    assert len({id(one.__enter__()) for one in borrowed}) == 5
    for one in borrowed:
        one.__exit__(None, None, None)
    assert len(pool._idle) == 2
    with pytest.raises(KeyError), pool.borrow():
        raise KeyError
    assert len(pool._idle) == 1


def test_a_search_stops_if_nobody_waits_for_it() -> None:
    """It stops within PAUSE_CELLS cells, and the next search on the same map is correct."""
    field = Field(np.ones((1000, 1000), np.bool_))
    looks = itertools.count()

    def route() -> search.Route:
        return field.route((0, 0), (999, 999), search.NO_HITS, None)

    whole = call_while(lambda: next(looks) >= 0, route, ())
    assert 1 <= next(looks) <= whole.expanded / PAUSE_CELLS + 1
    with pytest.raises(Unwanted):
        call_while(lambda: False, route, ())
    assert route().cost == whole.cost == pytest.approx(999 * math.sqrt(2))
    costs = np.full((1000, 1000), 100, np.uint8)
    with pytest.raises(Unwanted):
        call_while(lambda: False, lambda: field.route((0, 0), (999, 999), search.NO_HITS, costs), ())
