"""Occupancy grids: reading ROS map.yaml with its image and MovingAI `.map`, and what is asked of a grid.

Where a robot may go on a grid, and how, is the business of `planner`.
"""

import logging
import math
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.common.errors import DataError, MissingExtra
from offboard.common.planning import flood

log = logging.getLogger(__name__)

UNKNOWN, FREE, OCCUPIED = -1, 0, 100
CELLS_MAX = 2**26  # 67 million: 410 m x 410 m at 0.05 m
GREY_UNKNOWN = 205  # what map savers write for unknown
MODES = ("trinary", "scale", "raw")
IMAGE_FORMATS = ("PPM", "PNG", "BMP")  # PPM is Pillow's name for the PGM family
FREE_LETTERS, BLOCKED_LETTERS = ".GS", "@OTW"


@dataclass(frozen=True, eq=False)
class GridMap:
    """An occupancy grid with values as in ROS: -1 unknown, 0 free to 100 occupied; row 0 is at the lowest y.

    `resolution` is metres a cell, `origin` the pose (x, y in m, yaw in rad) of the corner of cell (0, 0).
    `cells` is read-only: its identity names the map as long as the process lives.
    """

    cells: NDArray[np.int8]
    resolution: float
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        cells = self.cells
        if not isinstance(cells, np.ndarray) or cells.dtype != np.int8 or cells.ndim != 2:
            raise ValueError("grid.cells is not an int8 array of two dimensions")
        if not 0 < cells.size <= CELLS_MAX:
            raise ValueError(f"grid.cells has {cells.size} cells, allowed are 1 to {CELLS_MAX}")
        if not (math.isfinite(self.resolution) and self.resolution > 0):
            raise ValueError(f"grid.resolution is {self.resolution}, not a number above 0")
        origin = tuple(float(value) for value in self.origin)
        if len(origin) != 3 or not all(map(math.isfinite, origin)):
            raise ValueError(f"grid.origin is {self.origin}, not three finite numbers x, y, yaw")
        if cells.flags.writeable or not cells.flags.c_contiguous:
            cells = cells.copy(order="C")
            cells.flags.writeable = False
        object.__setattr__(self, "cells", cells)
        object.__setattr__(self, "origin", origin)

    def position(self, x: float, y: float) -> tuple[float, float]:
        """A point of the map frame as (row, col) with fractions; cell (r, c) begins at (r, c)."""
        dx, dy, yaw = x - self.origin[0], y - self.origin[1], self.origin[2]
        along = dx * math.cos(yaw) + dy * math.sin(yaw)
        across = dy * math.cos(yaw) - dx * math.sin(yaw)
        return across / self.resolution, along / self.resolution

    def cell(self, x: float, y: float) -> tuple[int, int] | None:
        """The (row, col) that holds a point of the map frame, or None outside the map."""
        row, col = (math.floor(value) for value in self.position(x, y))
        inside = 0 <= row < self.cells.shape[0] and 0 <= col < self.cells.shape[1]
        return (row, col) if inside else None

    def metres(self, cells: NDArray[np.int32]) -> NDArray[np.float64]:
        """The centres of (row, col) cells as (x, y) in the map frame."""
        across, along = ((cells + 0.5) * self.resolution).reshape(-1, 2).T
        x, y, yaw = self.origin
        cos, sin = math.cos(yaw), math.sin(yaw)
        return np.stack((x + along * cos - across * sin, y + along * sin + across * cos), axis=1)


def read_map(path: Path | str) -> GridMap:
    """Read a ROS `.yaml` with its image, or a MovingAI `.map`; DataError names the file and what is wrong."""
    path = Path(path)
    if path.suffix in (".yaml", ".yml"):
        return _read_ros(path)
    if path.suffix == ".map":
        return _read_movingai(path)
    raise DataError(
        f"{path}: a map is a ROS .yaml or a MovingAI .map, not {path.suffix or 'a file without suffix'!r}"
    )


def path_size(distance_m: float, resolution: float, map_cells: int = 1) -> float:
    """The paper's input size d: n ln n cells to expand, n = 0.5 |AB|^2 / g^2, over the cells of the map."""
    n = 0.5 * distance_m**2 / resolution**2
    return n * math.log(n) / map_cells if n > 1 else 0.0


def passable(grid: GridMap, radius_m: float = 0.0) -> NDArray[np.bool_]:
    """Cells where the centre of a robot of this radius may be: known, and no occupied cell within the radius.

    Unknown cells are blocked but not inflated, as in nav2's default costmap.
    """
    known = grid.cells >= FREE
    if radius_m <= 0:
        return known & (grid.cells < OCCUPIED)
    return known & ~flood.inflate(grid.cells >= OCCUPIED, in_cells(grid, radius_m))


def in_cells(grid: GridMap, radius_m: float) -> float:
    """The radius in cells; a radius of whole cells stays whole, though 0.3 / 0.1 is below 3."""
    return radius_m / grid.resolution + 1e-6


def largest_component(cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The biggest connected part of the passable cells: 8-connected without corner cutting, which is the
    same as 4-connected."""
    return flood.largest_component(cells)


def free_pairs(grid: GridMap, count: int, seed: int, radius_m: float = 0.0) -> NDArray[np.int32]:
    """`count` random pairs of start and goal cells that a path joins, as (count, 2, 2) of (row, col)."""
    free = np.argwhere(largest_component(passable(grid, radius_m))).astype(np.int32)
    if not len(free):
        raise DataError("the map has no free cell for a start and a goal")
    return free[np.random.default_rng(seed).integers(len(free), size=(count, 2))]


def resampled(grid: GridMap, resolution: float) -> GridMap:
    """The same map in finer cells; the old resolution must be a whole multiple of the new one."""
    ratio = grid.resolution / resolution if resolution > 0 else 0.0
    factor = round(ratio)
    if factor < 1 or abs(ratio - factor) > 1e-6 * ratio:
        raise DataError(
            f"resolution {resolution} m: the map's own {grid.resolution} m is not a whole multiple of it"
        )
    if grid.cells.size * factor**2 > CELLS_MAX:
        raise DataError(f"resolution {resolution} m: the map would have more than {CELLS_MAX} cells")
    if factor == 1:
        return grid
    return GridMap(grid.cells.repeat(factor, axis=0).repeat(factor, axis=1), resolution, grid.origin)


def _read_ros(path: Path) -> GridMap:
    fields = _read_yaml(path)
    resolution = _number(path, fields, "resolution")
    if resolution <= 0:
        raise DataError(f"{path}: resolution is {resolution:g}, it must be above 0")
    occupied, free = _number(path, fields, "occupied_thresh"), _number(path, fields, "free_thresh")
    for name, value in (("occupied_thresh", occupied), ("free_thresh", free)):
        if not 0 <= value <= 1:
            raise DataError(f"{path}: {name} is {value:g}, allowed are 0 to 1")
    if free >= occupied:
        raise DataError(f"{path}: free_thresh {free:g} is not below occupied_thresh {occupied:g}")
    mode = fields.get("mode", "trinary")
    if mode not in MODES:
        raise DataError(f"{path}: mode {mode!r} is not one of {', '.join(MODES)}")
    negate = fields.get("negate")
    if negate not in (0, 1):
        raise DataError(f"{path}: negate is {negate!r}, allowed are 0 and 1")
    origin = fields.get("origin")
    if not (isinstance(origin, list) and len(origin) == 3 and all(_is_number(value) for value in origin)):
        raise DataError(f"{path}: origin is {origin!r}, it must be three numbers [x, y, yaw]")
    image = fields.get("image")
    if not (isinstance(image, str) and image):
        raise DataError(f"{path}: image is {image!r}, it must name a file")
    grey, opaque = _read_image(path, path.parent / image)
    occupancy = _occupancy(mode, bool(negate), occupied, free)
    if mode != "raw" and occupancy[GREY_UNKNOWN] == FREE and (grey == GREY_UNKNOWN).any():
        log.warning(
            "%s: grey %d, by convention unknown, is free with free_thresh %g", path, GREY_UNKNOWN, free
        )
    cells = occupancy[grey]
    if mode != "raw":
        cells[~opaque] = UNKNOWN
    return GridMap(cells[::-1], resolution, (float(origin[0]), float(origin[1]), float(origin[2])))


def _occupancy(mode: str, negate: bool, occupied: float, free: float) -> NDArray[np.int8]:
    """The cell value of each grey level, as nav2's map_server computes it (in float32)."""
    grey = np.arange(256)
    if mode == "raw":
        return np.where(grey <= OCCUPIED, grey, UNKNOWN).astype(np.int8)
    dark = grey.astype(np.float32) / np.float32(255)
    if not negate:
        dark = np.float32(1) - dark
    high, low = np.float32(occupied), np.float32(free)
    between = np.full(256, UNKNOWN, np.float32)
    if mode == "scale":
        between = np.floor((dark - low) / np.float32(occupied - free) * np.float32(100) + np.float32(0.5))
    return np.where(dark <= low, FREE, np.where(dark >= high, OCCUPIED, between)).astype(np.int8)


def _read_yaml(path: Path) -> dict[str, Any]:
    try:
        import yaml
    except ImportError:
        raise MissingExtra("reading a map.yaml", "planning") from None
    try:
        fields = yaml.safe_load(path.read_text())
    except FileNotFoundError:
        raise DataError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise DataError(f"{path}: not readable as YAML: {' '.join(str(error).split())}") from error
    if not isinstance(fields, dict):
        raise DataError(f"{path}: not a map.yaml: it holds no fields")
    return fields


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _number(path: Path, fields: dict[str, Any], name: str) -> float:
    if name not in fields:
        raise DataError(f"{path}: {name} is missing")
    if not _is_number(fields[name]):
        raise DataError(f"{path}: {name} is {fields[name]!r}, it must be a number")
    return float(fields[name])


def _read_image(path: Path, image_path: Path) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Grey level and opacity of each pixel, top row first."""
    try:
        from PIL import Image, UnidentifiedImageError
    except ImportError:
        raise MissingExtra("reading a map's image", "planning") from None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # we have our own bound
            image = Image.open(image_path, formats=IMAGE_FORMATS)
        with image:
            if image.width * image.height > CELLS_MAX:
                raise DataError(
                    f"{image_path}: {image.width} x {image.height} cells, allowed are {CELLS_MAX}"
                )
            if image.mode.startswith("I"):  # 16 bits a pixel
                wide = np.asarray(image).astype(np.int64).clip(0, 65535)
                return ((wide * 255 + 32767) // 65535).astype(np.uint8), np.ones(wide.shape, np.bool_)
            grey = np.asarray(image.convert("RGB").convert("L"))
            return grey, np.asarray(image.convert("RGBA").getchannel("A")) == 255
    except FileNotFoundError:
        raise DataError(f"{path}: image {image_path} does not exist") from None
    except (UnidentifiedImageError, Image.DecompressionBombError, OSError, ValueError, SyntaxError) as error:
        raise DataError(f"{path}: image {image_path} is not a readable PGM, PNG or BMP: {error}") from error


def _read_movingai(path: Path) -> GridMap:
    """Rows stay in the order of the file, so that (x, y) of a `.scen` line is (col, row)."""
    try:
        lines = path.read_text(encoding="ascii").splitlines()
    except FileNotFoundError:
        raise DataError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: not readable as text: {error}") from error
    if [line.split()[:1] for line in lines[:4]] != [["type"], ["height"], ["width"], ["map"]]:
        raise DataError(f"{path}:1: not a MovingAI map: the first lines must be type, height, width, map")
    height, width = _side(path, lines, 2), _side(path, lines, 3)
    if height * width > CELLS_MAX:
        raise DataError(f"{path}: {width} x {height} cells, allowed are {CELLS_MAX}")
    if len(lines) < 4 + height:
        raise DataError(f"{path}: {len(lines) - 4} rows, the header says {height}")
    rows = lines[4 : 4 + height]
    for number, row in enumerate(rows, 5):
        if len(row) != width or row.strip(FREE_LETTERS + BLOCKED_LETTERS):
            raise DataError(f"{path}:{number}: a row is {width} letters of {FREE_LETTERS}{BLOCKED_LETTERS}")
    letters = np.frombuffer("".join(rows).encode(), np.uint8).reshape(height, width)
    free = np.isin(letters, np.frombuffer(FREE_LETTERS.encode(), np.uint8))
    return GridMap(np.where(free, FREE, OCCUPIED).astype(np.int8), 1.0)


def _side(path: Path, lines: list[str], number: int) -> int:
    words = lines[number - 1].split()
    if len(words) != 2 or not words[1].isdecimal() or int(words[1]) < 1:
        raise DataError(f"{path}:{number}: {lines[number - 1]!r} is not a size like '{words[0]} 512'")
    return int(words[1])
