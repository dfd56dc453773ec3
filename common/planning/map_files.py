"""Reads map files: a ROS map.yaml with its image, as nav2's map_server does, or a MovingAI `.map`."""

import logging
import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.common.errors import DataError, MissingExtra
from offboard.common.planning.maps import CELLS_MAX, FREE, OCCUPIED, UNKNOWN, GridMap

log = logging.getLogger(__name__)

GREY_UNKNOWN = 205  # the grey level that map savers write for unknown cells
MODES = ("trinary", "scale", "raw")
IMAGE_FORMATS = ("PPM", "PNG", "BMP")  # PPM is Pillow's name for the PGM family
FREE_LETTERS, BLOCKED_LETTERS = ".GS", "@OTW"


def read_map(path: Path | str) -> GridMap:
    """Read a ROS `.yaml` with its image, or a MovingAI `.map`. DataError names the file and what is wrong."""
    path = Path(path)
    if path.suffix in (".yaml", ".yml"):
        return _read_ros(path)
    if path.suffix == ".map":
        return _read_movingai(path)
    raise DataError(
        f"{path}: a map is a ROS .yaml or a MovingAI .map, not {path.suffix or 'a file without suffix'!r}"
    )


def _read_ros(path: Path) -> GridMap:
    fields = _read_yaml(path)
    resolution = _number(path, fields, "resolution")
    if resolution <= 0:
        raise DataError(f"{path}: resolution is {resolution:g}, it must be above 0")
    occupied, free = _thresholds(path, fields)
    mode = fields.get("mode", "trinary")
    if mode not in MODES:
        raise DataError(f"{path}: mode {mode!r} is not one of {', '.join(MODES)}")
    negate = fields.get("negate")
    if negate not in (0, 1):
        raise DataError(f"{path}: negate is {negate!r}, allowed are 0 and 1")
    origin = _origin(path, fields)
    image = fields.get("image")
    if not (isinstance(image, str) and image):
        raise DataError(f"{path}: image is {image!r}, it must be the name of a file")
    grey, opaque = _read_image(path, path.parent / image)
    occupancy = _occupancy(mode, negate=bool(negate), occupied=occupied, free=free)
    cells = occupancy[grey]
    if mode != "raw":
        if occupancy[GREY_UNKNOWN] == FREE and (grey == GREY_UNKNOWN).any():
            log.warning(
                "%s: pixels of grey %d usually mean unknown, but free_thresh %g makes them free; "
                "remedy: lower it to 0.196 if they are unknown", path, GREY_UNKNOWN, free,
            )  # fmt: skip
        cells[~opaque] = UNKNOWN
    return GridMap(cells[::-1], resolution, origin)


def _thresholds(path: Path, fields: dict[str, Any]) -> tuple[float, float]:
    occupied, free = _number(path, fields, "occupied_thresh"), _number(path, fields, "free_thresh")
    for name, value in (("occupied_thresh", occupied), ("free_thresh", free)):
        if not 0 <= value <= 1:
            raise DataError(f"{path}: {name} is {value:g}, allowed are 0 to 1")
    if free >= occupied:
        raise DataError(f"{path}: free_thresh {free:g} is not below occupied_thresh {occupied:g}")
    return occupied, free


def _origin(path: Path, fields: dict[str, Any]) -> tuple[float, float, float]:
    origin = fields.get("origin")
    if not (isinstance(origin, list) and len(origin) == 3 and all(_is_number(value) for value in origin)):
        raise DataError(f"{path}: origin is {origin!r}, it must be three numbers [x, y, yaw]")
    return float(origin[0]), float(origin[1]), float(origin[2])


def _occupancy(mode: str, *, negate: bool, occupied: float, free: float) -> NDArray[np.int8]:
    """The cell value of each grey level, computed like nav2's map_server, in float32."""
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
        raise DataError(f"{path}: not valid YAML: {' '.join(str(error).split())}") from error
    if not isinstance(fields, dict):
        raise DataError(f"{path}: not a map.yaml: it has no fields")
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
    """For each pixel, top row first: its grey level, and True if it is opaque."""
    try:
        from PIL import Image, UnidentifiedImageError
    except ImportError:
        raise MissingExtra("reading a map's image", "planning") from None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # CELLS_MAX is our own limit
            image = Image.open(image_path, formats=IMAGE_FORMATS)
        with image:
            if image.width * image.height > CELLS_MAX:
                raise DataError(
                    f"{image_path}: {image.width} x {image.height} cells, at most {CELLS_MAX} are allowed"
                )
            if image.mode.startswith("I"):  # 16 bits per pixel
                wide = np.asarray(image).astype(np.int64).clip(0, 65535)
                return ((wide * 255 + 32767) // 65535).astype(np.uint8), np.ones(wide.shape, np.bool_)
            grey = np.asarray(image.convert("RGB").convert("L"))
            return grey, np.asarray(image.convert("RGBA").getchannel("A")) == 255
    except FileNotFoundError:
        raise DataError(f"{path}: image {image_path} does not exist") from None
    except (UnidentifiedImageError, Image.DecompressionBombError, OSError, ValueError, SyntaxError) as error:
        raise DataError(f"{path}: image {image_path} is not a readable PGM, PNG or BMP: {error}") from error


def _read_movingai(path: Path) -> GridMap:
    """Keep the rows in the order of the file, so that (x, y) of a `.scen` line is (column, row)."""
    try:
        lines = path.read_text(encoding="ascii").splitlines()
    except FileNotFoundError:
        raise DataError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: not a text file: {error}") from error
    if [line.split()[:1] for line in lines[:4]] != [["type"], ["height"], ["width"], ["map"]]:
        raise DataError(f"{path}:1: not a MovingAI map: the first lines must be type, height, width, map")
    height, width = _side(path, lines, 2), _side(path, lines, 3)
    if height * width > CELLS_MAX:
        raise DataError(f"{path}: {width} x {height} cells, at most {CELLS_MAX} are allowed")
    if len(lines) < 4 + height:
        raise DataError(f"{path}: {len(lines) - 4} rows, but height is {height}")
    rows = lines[4 : 4 + height]
    for number, row in enumerate(rows, 5):
        if len(row) != width or row.strip(FREE_LETTERS + BLOCKED_LETTERS):
            raise DataError(
                f"{path}:{number}: a row must be {width} letters of {FREE_LETTERS}{BLOCKED_LETTERS}"
            )
    letters = np.frombuffer("".join(rows).encode(), np.uint8).reshape(height, width)
    free = np.isin(letters, np.frombuffer(FREE_LETTERS.encode(), np.uint8))
    return GridMap(np.where(free, FREE, OCCUPIED).astype(np.int8), 1.0)


def _side(path: Path, lines: list[str], number: int) -> int:
    words = lines[number - 1].split()
    if len(words) != 2 or not words[1].isdecimal() or int(words[1]) < 1:
        raise DataError(f"{path}:{number}: {lines[number - 1]!r} must be a size like '{words[0]} 512'")
    return int(words[1])
