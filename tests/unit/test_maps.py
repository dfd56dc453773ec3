"""Reading maps as nav2's map_server does, naming what is wrong, and what is asked of a grid."""

import logging
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from offboard.common.errors import DataError
from offboard.common.planning import maps, planner
from offboard.common.planning.maps import GridMap, read_map

ROOT = Path(__file__).parents[2]
planner.warm()  # compiles before the clock of any test runs

FIELDS = {
    "image": "map.pgm",
    "resolution": "0.05",
    "origin": "[-1.0, 2.0, 0.0]",
    "negate": "0",
    "occupied_thresh": "0.65",
    "free_thresh": "0.196",
}


def write_map(folder: Path, pixels: NDArray[np.uint8], image: str = "map.pgm", **fields: str | None) -> Path:
    """A map.yaml with its image; a field given as None is left out."""
    Image.fromarray(pixels).save(folder / image)
    path = folder / "map.yaml"
    merged = {**FIELDS, "image": image, **fields}
    path.write_text("".join(f"{name}: {value}\n" for name, value in merged.items() if value is not None))
    return path


GREYS = np.array([[0, 89, 90, 100], [101, 204, 205, 206], [207, 253, 254, 255]], np.uint8)


def occupancy(grey: int, mode: str, negate: bool, occupied: float, free: float) -> int:
    """map_server's rule for one pixel, written out anew; its float32 decides at halves."""
    if mode == "raw":
        return grey if grey <= 100 else -1
    dark = np.float32(grey) / np.float32(255)
    dark = dark if negate else np.float32(1) - dark
    if dark >= occupied:
        return 100
    if dark <= free:
        return 0
    share = (dark - np.float32(free)) / np.float32(occupied - free)
    return -1 if mode == "trinary" else math.floor(share * np.float32(100) + np.float32(0.5))


@pytest.mark.parametrize("mode", maps.MODES)
@pytest.mark.parametrize("negate", [False, True])
@pytest.mark.parametrize("thresholds", [(0.65, 0.196), (0.65, 0.25), (0.9, 0.1)])
def test_each_mode_follows_map_server(
    tmp_path: Path, mode: str, negate: bool, thresholds: tuple[float, float]
) -> None:
    """Every grey level becomes the value map_server gives it, and the last image row is row 0."""
    pixels = np.arange(256, dtype=np.uint8).reshape(16, 16)
    fields = {"occupied_thresh": str(thresholds[0]), "free_thresh": str(thresholds[1])}
    grid = read_map(write_map(tmp_path, pixels, mode=mode, negate=str(int(negate)), **fields))
    expected = [[occupancy(int(grey), mode, negate, *thresholds) for grey in row] for row in pixels[::-1]]
    assert grid.cells.tolist() == expected
    assert (grid.resolution, grid.origin) == (0.05, (-1.0, 2.0, 0.0))
    assert not grid.cells.flags.writeable
    assert grid.cells.flags.c_contiguous


@pytest.mark.parametrize(("mode", "value"), [("trinary", -1), ("scale", -1), ("raw", 0)])
def test_transparent_pixels_are_unknown(tmp_path: Path, mode: str, value: int) -> None:
    """A pixel that is not opaque is unknown in trinary and scale; raw does not look at it."""
    pixels = np.zeros((1, 2, 4), np.uint8)
    pixels[0, :, 3] = (255, 254)
    grid = read_map(write_map(tmp_path, pixels, image="map.png", mode=mode))
    assert grid.cells.tolist() == [[0 if mode == "raw" else 100, value]]


def test_sixteen_bit_images_keep_their_shade(tmp_path: Path) -> None:
    """A PGM of 16 bits reads as the same greys in 8 bits."""
    (tmp_path / "map.pgm").write_bytes(b"P5 4 3 65535\n" + (GREYS.astype(">u2") * 257).tobytes())
    deep = tmp_path / "deep.yaml"
    deep.write_text("".join(f"{name}: {value}\n" for name, value in {**FIELDS, "mode": "raw"}.items()))
    assert read_map(deep).cells.tolist() == np.where(GREYS <= 100, GREYS, 255).astype(np.int8)[::-1].tolist()


def test_grey_205_that_turns_free_is_obeyed_and_said(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """With free_thresh 0.25 grey 205 is free, and a warning says so; with 0.196 it is unknown, silently."""
    with caplog.at_level(logging.WARNING):
        assert read_map(write_map(tmp_path, GREYS)).cells[1, 2] == -1
        assert not caplog.records
        assert read_map(write_map(tmp_path, GREYS, free_thresh="0.25")).cells[1, 2] == 0
    assert "grey 205" in caplog.text


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"resolution": None}, "resolution is missing"),
        ({"resolution": "0"}, "resolution is 0"),
        ({"resolution": "-0.1"}, "resolution is -0.1"),
        ({"resolution": "fine"}, "resolution is 'fine'"),
        ({"resolution": ".nan"}, "resolution is nan"),
        ({"free_thresh": None}, "free_thresh is missing"),
        ({"occupied_thresh": "1.5"}, "occupied_thresh is 1.5"),
        ({"free_thresh": "-0.1"}, "free_thresh is -0.1"),
        ({"free_thresh": "0.7"}, "free_thresh 0.7 is not below"),
        ({"mode": "ternary"}, "mode 'ternary'"),
        ({"negate": "2"}, "negate is 2"),
        ({"origin": "[0, 0]"}, "origin is"),
        ({"origin": "[0, 0, north]"}, "origin is"),
        ({"image": "absent.pgm"}, "does not exist"),
        ({"image": "[]"}, "image is"),
        ({"image": "map.yaml"}, "not a readable PGM, PNG or BMP"),
    ],
)
def test_bad_fields_are_named(tmp_path: Path, fields: dict[str, str | None], said: str) -> None:
    """A wrong field is one line that names the file and the field."""
    Image.fromarray(GREYS).save(tmp_path / "map.pgm")
    path = tmp_path / "map.yaml"
    merged = {**FIELDS, **fields}
    path.write_text("".join(f"{name}: {value}\n" for name, value in merged.items() if value is not None))
    with pytest.raises(DataError) as error:
        read_map(path)
    assert str(error.value).startswith(f"{path}: ")
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_bad_files_are_named(tmp_path: Path) -> None:
    """A missing, unreadable or oversized file, or one of another kind, is a DataError with its name."""
    broken, text, huge = tmp_path / "broken.yaml", tmp_path / "text.yaml", tmp_path / "huge.yaml"
    broken.write_text("image: [\n")
    text.write_text("just words\n")
    (tmp_path / "huge.pgm").write_bytes(b"P5 10000 10000 255\n")
    (tmp_path / "enormous.pgm").write_bytes(b"P5 32000 32000 255\n")
    enormous = tmp_path / "enormous.yaml"
    enormous.write_text("".join(f"{n}: {v}\n" for n, v in {**FIELDS, "image": "enormous.pgm"}.items()))
    huge.write_text("".join(f"{n}: {v}\n" for n, v in {**FIELDS, "image": "huge.pgm"}.items()))
    for path, said in (
        (tmp_path / "absent.yaml", "no such file"),
        (tmp_path / "absent.map", "no such file"),
        (tmp_path / "picture.png", "a map is a ROS .yaml"),
        (broken, "not readable as YAML"),
        (text, "it holds no fields"),
        (huge, "cells, allowed are"),
        (enormous, "exceeds limit"),
    ):
        with pytest.raises(DataError, match=said) as error:
            read_map(path)
        assert str(tmp_path) in str(error.value)


def test_torn_images_are_refused(tmp_path: Path) -> None:
    """An image that ends too early is an error, not a half-read map."""
    path = write_map(tmp_path, np.zeros((40, 40), np.uint8), image="map.png")
    picture = tmp_path / "map.png"
    picture.write_bytes(picture.read_bytes()[:-30])
    with pytest.raises(DataError, match="not a readable"):
        read_map(path)


def test_movingai_rows_keep_their_order(tmp_path: Path) -> None:
    """Cell (y, x) is letter x of line y, as `.scen` files count; the cells are 1 m."""
    path = tmp_path / "small.map"
    path.write_text("type octile\nheight 2\nwidth 3\nmap\n.G@\nTSW\n")
    grid = read_map(path)
    assert grid.cells.tolist() == [[0, 0, 100], [100, 0, 100]]
    assert grid.resolution == 1.0
    assert grid.cell(1.5, 0.5) == (0, 1)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", ":1: not a MovingAI map"),
        ("type octile\nheight x\nwidth 3\nmap\n", ":2: 'height x'"),
        ("type octile\nheight 2\nwidth 0\nmap\n", ":3: 'width 0'"),
        ("type octile\nheight 2\nwidth 3\nmap\n...\n", "1 rows, the header says 2"),
        ("type octile\nheight 2\nwidth 3\nmap\n...\n..\n", ":6: a row is 3 letters"),
        ("type octile\nheight 1\nwidth 3\nmap\n.x.\n", ":5: a row is 3 letters"),
        ("type octile\nheight 90000\nwidth 90000\nmap\n", "cells, allowed are"),
    ],
)
def test_bad_movingai_lines_are_named(tmp_path: Path, text: str, said: str) -> None:
    """A wrong `.map` is one line with file and line."""
    path = tmp_path / "bad.map"
    path.write_text(text)
    with pytest.raises(DataError) as error:
        read_map(path)
    assert said in str(error.value)


def test_the_maps_of_the_repository_read() -> None:
    """Willow and the depot have the size and the share of free cells that their origin has."""
    willow, depot = read_map(ROOT / "maps/willow-full-0.05.yaml"), read_map(ROOT / "maps/depot.yaml")
    assert (willow.cells.shape, depot.cells.shape) == ((945, 1165), (307, 604))
    assert round(float((willow.cells == 0).mean()), 3) == 0.499
    assert round(float((willow.cells == -1).mean()), 3) == 0.489
    assert round(float((depot.cells == 0).mean()), 3) == 0.968


def test_the_largest_component_is_one_flood() -> None:
    """On the depot it is what a plain flood from one of its cells reaches, and the greater part."""
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


def test_a_grid_refuses_what_is_no_map() -> None:
    """Wrong types, shapes, resolutions and origins are a ValueError; an origin may come as a list."""
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


def test_a_read_only_array_stays_the_same_object() -> None:
    """The identity of the cells names a map, so cells that need no copy are not copied."""
    cells = np.zeros((2, 3), np.int8)
    grid = GridMap(cells, 1.0)
    assert cells.flags.writeable
    assert GridMap(grid.cells, 1.0).cells is grid.cells


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.5])
def test_cells_and_metres_are_inverse(yaw: float) -> None:
    """The centre of every cell lies in that cell, whatever the origin's yaw; beyond the edge is no cell."""
    grid = GridMap(np.zeros((3, 5), np.int8), 0.05, (-3.0, 7.0, yaw))
    cells = np.argwhere(grid.cells == 0).astype(np.int32)
    centres = grid.metres(cells)
    assert [grid.cell(x, y) for x, y in centres] == [tuple(cell) for cell in cells.tolist()]
    for outside in ([-1, 0], [3, 0], [0, -1], [0, 5]):
        x, y = grid.metres(np.array([outside], np.int32))[0]
        assert grid.cell(x, y) is None


def test_resampling_repeats_cells_exactly() -> None:
    """0.05 m to 0.025 m is every cell 2 x 2 times; ratios that are not whole are refused."""
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
    """Two free areas that touch at a corner only are two components."""
    free = np.array([[1, 1, 0, 0], [1, 1, 0, 1], [0, 0, 1, 1]], np.bool_)
    expected = np.array([[1, 1, 0, 0], [1, 1, 0, 0], [0, 0, 0, 0]], np.bool_)
    assert maps.largest_component(free).tolist() == expected.tolist()
    assert not maps.largest_component(np.zeros((2, 2), np.bool_)).any()


@pytest.mark.parametrize("radius", [0.0, 0.5, 1.0, 1.5, 2.9, 5.0])
def test_inflation_is_the_disc_around_every_obstacle(radius: float) -> None:
    """A cell is passable when it is known and no occupied cell's centre is within the radius."""
    cells = np.random.default_rng(3).choice([-1, 0, 50, 100], (20, 30), p=[0.05, 0.8, 0.1, 0.05])
    grid = GridMap(cells.astype(np.int8), 0.1)
    occupied = np.argwhere(cells == 100)
    for row, col in np.ndindex(cells.shape):
        clear = np.hypot(*(occupied - (row, col)).T).min() > radius + 1e-6 or (
            radius == 0 and cells[row, col] < 100
        )
        assert maps.passable(grid, radius * 0.1)[row, col] == (clear and cells[row, col] >= 0), (row, col)


def test_free_pairs_are_joined_and_seeded() -> None:
    """Both ends lie in the largest component, and the seed alone decides which."""
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
    """n = 245,280 gives d = 3,043,963 before it is divided by the map's cells; n <= 1 gives 0."""
    distance = math.sqrt(2 * 245_280) * 0.05
    assert maps.path_size(distance, 0.05) == pytest.approx(3_043_963, abs=1)
    assert maps.path_size(distance, 0.05, 1000) == pytest.approx(3_043.963, abs=1e-3)
    assert maps.path_size(0.0, 0.05, 1000) == 0.0
    assert maps.path_size(1.4 * 0.05, 0.05, 1000) == 0.0
