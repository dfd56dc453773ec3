"""Occupancy grids: cells and metres, passable cells, components, and input sizes."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from offboard.common.errors import DataError
from offboard.common.planning import maps, planner
from offboard.common.planning.map_files import read_map
from offboard.common.planning.maps import GridMap

ROOT = Path(__file__).parents[2]
planner.warm()  # compile now, so that the timeout of no test includes it


def test_the_largest_component_is_connected() -> None:
    """On the depot it is what a plain flood fill reaches, and more than half of the free cells."""
    free = maps.passable(read_map(ROOT / "maps/depot.yaml"))
    found = maps.largest_component(free)
    start = tuple(np.argwhere(found)[0].tolist())
    reached, stack = {start}, [start]
    while stack:
        row, col = stack.pop()
        for r, c in ((row - 1, col), (row + 1, col), (row, col - 1), (row, col + 1)):
            inside = 0 <= r < free.shape[0] and 0 <= c < free.shape[1]
            if inside and free[r, c] and (r, c) not in reached:
                reached.add((r, c))
                stack.append((r, c))
    assert reached == set(map(tuple, np.argwhere(found).tolist()))
    assert len(reached) > free.sum() / 2


def test_a_grid_checks_its_fields() -> None:
    """Wrong types, shapes, resolutions and origins are a ValueError; an origin may be a list."""
    cells = np.zeros((2, 3), np.int8)
    wrong: list[tuple[Any, Any, Any]] = [
        (np.zeros((2, 3)), 1.0, (0.0, 0.0, 0.0)),
        (np.zeros(3, np.int8), 1.0, (0.0, 0.0, 0.0)),
        (np.zeros((0, 3), np.int8), 1.0, (0.0, 0.0, 0.0)),
        (cells, math.nan, (0.0, 0.0, 0.0)),
        (cells, 0.0, (0.0, 0.0, 0.0)),
        (cells, 1.0, (0.0, math.inf, 0.0)),
        (cells, 1.0, (0.0, 0.0)),
    ]
    for arguments in wrong:
        with pytest.raises(ValueError, match=r"grid\."):
            GridMap(*arguments)
    assert GridMap(cells, 1.0, [1, 2, 3]).origin == (1.0, 2.0, 3.0)  # type: ignore[arg-type]


def test_nothing_changes_the_cells_of_a_map() -> None:
    """The identity of the cells names a map, so a map has its own copy, which cannot be unlocked."""
    cells = np.zeros((2, 3), np.int8)
    older = cells[:]
    cells.flags.writeable = False
    grid = GridMap(cells, 1.0)
    older[:] = 100
    assert not grid.cells.any()
    with pytest.raises(ValueError, match="cannot set WRITEABLE flag"):
        grid.cells.flags.writeable = True
    assert GridMap(grid.cells, 1.0).cells is grid.cells


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.5])
def test_cells_and_metres_are_inverse(yaw: float) -> None:
    """For any yaw of the origin the centre of a cell lies in that cell; outside the map there is no cell."""
    grid = GridMap(np.zeros((3, 5), np.int8), 0.05, (-3.0, 7.0, yaw))
    cells = np.argwhere(grid.cells == 0).astype(np.int32)
    centres = grid.metres(cells)
    assert [grid.cell(x, y) for x, y in centres] == [tuple(cell) for cell in cells.tolist()]
    for outside in ([-1, 0], [3, 0], [0, -1], [0, 5]):
        x, y = grid.metres(np.array([outside], np.int32))[0]
        assert grid.cell(x, y) is None


def test_resampling_repeats_cells_exactly() -> None:
    """From 0.05 m to 0.025 m each cell becomes 2 x 2 cells; ratios that are not whole are refused."""
    grid = GridMap(np.arange(6, dtype=np.int8).reshape(2, 3), 0.05, (1.0, 2.0, 0.5))
    fine = maps.resampled(grid, 0.025)
    assert fine.cells.tolist() == np.kron(grid.cells, np.ones((2, 2), np.int8)).tolist()
    assert (fine.resolution, fine.origin) == (0.025, grid.origin)
    assert maps.resampled(grid, 0.05) is grid
    for resolution in (0.03, 0.1, 0.0, -1.0, math.nan):
        with pytest.raises(DataError, match="whole multiple"):
            maps.resampled(grid, resolution)
    with pytest.raises(DataError, match="more than"):
        maps.resampled(grid, 0.05 / 8000)


def test_the_largest_component_does_not_cut_corners() -> None:
    """Two free areas that touch only at a corner are two components."""
    free = np.array([[1, 1, 0, 0], [1, 1, 0, 1], [0, 0, 1, 1]], np.bool_)
    expected = np.array([[1, 1, 0, 0], [1, 1, 0, 0], [0, 0, 0, 0]], np.bool_)
    assert maps.largest_component(free).tolist() == expected.tolist()
    assert not maps.largest_component(np.zeros((2, 2), np.bool_)).any()


@pytest.mark.parametrize("radius", [0.0, 0.5, 1.0, 1.5, 2.9, 5.0])
def test_inflation_is_the_disc_around_every_obstacle(radius: float) -> None:
    """A cell is passable if it is known and the centre of no occupied cell is within the radius."""
    cells = np.random.default_rng(3).choice([-1, 0, 50, 100], (20, 30), p=[0.05, 0.8, 0.1, 0.05])
    grid = GridMap(cells.astype(np.int8), 0.1)
    occupied = np.argwhere(cells == 100)
    for row, col in np.ndindex(cells.shape):
        clear = np.hypot(*(occupied - (row, col)).T).min() > radius + 1e-6 or (
            radius == 0 and cells[row, col] < 100
        )
        assert maps.passable(grid, radius * 0.1)[row, col] == (clear and cells[row, col] >= 0), (row, col)


def test_free_pairs_are_connected_and_seeded() -> None:
    """Start and goal lie in the largest component, and the seed alone decides which cells they are."""
    cells = np.full((10, 10), 100, np.int8)
    cells[1:4, 1:9] = 0
    cells[6, 6] = 0
    grid = GridMap(cells, 1.0)
    pairs = maps.free_pairs(grid, 50, seed=4)
    assert pairs.shape == (50, 2, 2)
    assert (pairs[..., 0] < 4).all()
    assert pairs.tolist() == maps.free_pairs(grid, 50, seed=4).tolist()
    assert pairs.tolist() != maps.free_pairs(grid, 50, seed=5).tolist()
    with pytest.raises(DataError, match="no free cell"):
        maps.free_pairs(GridMap(np.full((3, 3), 100, np.int8), 1.0), 1, seed=0)


def test_path_size_is_the_papers() -> None:
    """n = 245,280 gives d = 3,043,963 before the division by the map's cells; n <= 1 gives 0."""
    distance = math.sqrt(2 * 245_280) * 0.05
    assert maps.path_size(distance, 0.05) == pytest.approx(3_043_963, abs=1)
    assert maps.path_size(distance, 0.05, 1000) == pytest.approx(3_043.963, abs=1e-3)
    assert maps.path_size(0.0, 0.05, 1000) == 0.0
    assert maps.path_size(1.4 * 0.05, 0.05, 1000) == 0.0
