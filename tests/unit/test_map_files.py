"""Reading map files as nav2's map_server does, and the errors about wrong ones."""

import logging
import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from offboard.common.errors import DataError
from offboard.common.planning import map_files
from offboard.common.planning.map_files import read_map

ROOT = Path(__file__).parents[2]

FIELDS = {
    "image": "map.pgm",
    "resolution": "0.05",
    "origin": "[-1.0, 2.0, 0.0]",
    "negate": "0",
    "occupied_thresh": "0.65",
    "free_thresh": "0.196",
}


def write_map(folder: Path, pixels: NDArray[np.uint8], image: str = "map.pgm", **fields: str | None) -> Path:
    """Write a map.yaml with its image. A field that is None is left out."""
    Image.fromarray(pixels).save(folder / image)
    path = folder / "map.yaml"
    merged = {**FIELDS, "image": image, **fields}
    path.write_text("".join(f"{name}: {value}\n" for name, value in merged.items() if value is not None))
    return path


GREYS = np.array([[0, 89, 90, 100], [101, 204, 205, 206], [207, 253, 254, 255]], np.uint8)


def occupancy(grey: int, mode: str, negate: bool, occupied: float, free: float) -> int:
    """The rule of map_server for one pixel, written independently. It uses float32, as map_server does."""
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


@pytest.mark.parametrize("mode", map_files.MODES)
@pytest.mark.parametrize("negate", [False, True])
@pytest.mark.parametrize("thresholds", [(0.65, 0.196), (0.65, 0.25), (0.9, 0.1)])
def test_each_mode_reads_as_map_server_does(
    tmp_path: Path, mode: str, negate: bool, thresholds: tuple[float, float]
) -> None:
    """Every grey level gets the value of map_server, and the last row of the image is row 0."""
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
    """In the modes trinary and scale a pixel that is not opaque is unknown; raw ignores opacity."""
    pixels = np.zeros((1, 2, 4), np.uint8)
    pixels[0, :, 3] = (255, 254)
    grid = read_map(write_map(tmp_path, pixels, image="map.png", mode=mode))
    assert grid.cells.tolist() == [[0 if mode == "raw" else 100, value]]


def test_sixteen_bit_images_are_read(tmp_path: Path) -> None:
    """A PGM with 16 bits per pixel gives the same cells as one with 8 bits."""
    (tmp_path / "map.pgm").write_bytes(b"P5 4 3 65535\n" + (GREYS.astype(">u2") * 257).tobytes())
    deep = tmp_path / "deep.yaml"
    deep.write_text("".join(f"{name}: {value}\n" for name, value in {**FIELDS, "mode": "raw"}.items()))
    assert read_map(deep).cells.tolist() == np.where(GREYS <= 100, GREYS, 255).astype(np.int8)[::-1].tolist()


def test_a_free_grey_205_is_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """With free_thresh 0.25 grey 205 is free, with a warning; with 0.196 it is unknown, without one."""
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
    """The error about a wrong field is one line that names file and field."""
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
    """A missing, unreadable, too large or unknown file is a DataError that names it."""
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
        (broken, "not valid YAML"),
        (text, "it has no fields"),
        (huge, "10000 x 10000 cells, at most"),
        (enormous, "exceeds limit"),
    ):
        with pytest.raises(DataError, match=said) as error:
            read_map(path)
        assert str(tmp_path) in str(error.value)


def test_incomplete_images_are_refused(tmp_path: Path) -> None:
    """An image that ends too early is an error, not half a map."""
    path = write_map(tmp_path, np.zeros((40, 40), np.uint8), image="map.png")
    picture = tmp_path / "map.png"
    picture.write_bytes(picture.read_bytes()[:-30])
    with pytest.raises(DataError, match="not a readable"):
        read_map(path)


def test_movingai_rows_keep_their_order(tmp_path: Path) -> None:
    """Cell (y, x) is letter x of line y, as `.scen` files count; a cell is 1 m wide."""
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
        ("type octile\nheight 2\nwidth 3\nmap\n...\n", "1 rows, but height is 2"),
        ("type octile\nheight 2\nwidth 3\nmap\n...\n..\n", ":6: a row must be 3 letters"),
        ("type octile\nheight 1\nwidth 3\nmap\n.x.\n", ":5: a row must be 3 letters"),
        ("type octile\nheight 90000\nwidth 90000\nmap\n", "cells, at most"),
    ],
)
def test_bad_movingai_lines_are_named(tmp_path: Path, text: str, said: str) -> None:
    """The error about a wrong `.map` names file and line."""
    path = tmp_path / "bad.map"
    path.write_text(text)
    with pytest.raises(DataError) as error:
        read_map(path)
    assert said in str(error.value)


def test_the_maps_of_the_repository_are_read() -> None:
    """Willow Garage and the depot have the sizes and shares of free cells of their sources."""
    willow, depot = read_map(ROOT / "maps/willow-full-0.05.yaml"), read_map(ROOT / "maps/depot.yaml")
    assert (willow.cells.shape, depot.cells.shape) == ((945, 1165), (307, 604))
    assert round(float((willow.cells == 0).mean()), 3) == 0.499
    assert round(float((willow.cells == -1).mean()), 3) == 0.489
    assert round(float((depot.cells == 0).mean()), 3) == 0.968
