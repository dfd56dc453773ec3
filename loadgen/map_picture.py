"""A picture of a plan: the map, the robot, what its LiDAR saw, and the path.

The plans come from the run. Reading maps is left to `common.planning.map_files`.
"""

import io
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from offboard.common.errors import ConfigError, MissingExtra
from offboard.common.planning.maps import FREE, OCCUPIED, GridMap
from offboard.common.planning.planner import Plan, Point, Pose, Scan, scan_hits
from offboard.common.security.plain_files import replace_file

if TYPE_CHECKING:
    from PIL.ImageDraw import ImageDraw

SIDE_PIXELS = 1200  # of the longer side of the map
LEGEND_PIXELS = 44
FONT_PIXELS = 18
MARK_PIXELS = 9  # smallest radius of robot and goal: on a large map they would be dots
PATH_PIXELS, HIT_PIXELS = 4, 2

Colour = tuple[int, int, int]
# Colour-blind readers can tell them apart.
WHITE, BLACK, GREY = (255, 255, 255), (40, 44, 52), (196, 200, 206)
PATH, SCAN, ROBOT, GOAL = ((0, 114, 178), (213, 94, 0), (0, 130, 90), (170, 60, 130))
LEGEND: tuple[tuple[str, Colour], ...] = (
    ("robot", ROBOT),
    ("goal", GOAL),
    ("path", PATH),
    ("seen by the LiDAR", SCAN),
    ("occupied", BLACK),
    ("unknown", GREY),
)


class LastPlan:
    """Keeps the last plan with a path, and what the robot knew when it asked; `path` is its picture."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._last: tuple[Sequence[Any], Plan] | None = None

    def keep(self, request: Sequence[Any], answer: Any) -> None:
        """Look at the arguments of a task and at its answer; None: there is no answer."""
        if isinstance(answer, Plan) and answer.status == "NONE":
            self._last = request, answer

    def write(self) -> str:
        """Write the picture as a PNG; one line says where it is."""
        path = self._path
        if self._last is None:
            return f"{path} is not drawn: no plan found a path"
        (grid, scan, pose, goal, radius_m, *_), plan = self._last
        drawn = draw_plan(grid, plan, scan=scan, pose=pose, goal=goal, radius_m=radius_m)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            replace_file(path, drawn)
        except OSError as error:
            raise ConfigError(f"--picture: {path} cannot be written: {error.strerror}") from error
        return f"picture of the last plan: {path}"


def draw_plan(
    grid: GridMap, plan: Plan, *, scan: Scan | None, pose: Pose, goal: Point, radius_m: float
) -> bytes:
    """The picture as the bytes of a PNG; higher y is further up."""
    try:
        from PIL import Image, ImageDraw
    except ImportError:
        raise MissingExtra("drawing a plan", "planning") from None
    rows, cols = grid.cells.shape
    scale = SIDE_PIXELS / max(rows, cols)
    size = max(1, round(cols * scale)), max(1, round(rows * scale))
    there = Image.fromarray(_colours(grid.cells)[::-1]).resize(size, Image.Resampling.BOX)
    picture = Image.new("RGB", (size[0], size[1] + LEGEND_PIXELS), WHITE)
    picture.paste(there)
    draw = ImageDraw.Draw(picture)

    def pixels(places: Iterable[Any]) -> list[tuple[float, float]]:
        """Fractional (row, column) as pixels (x, y)."""
        return [(col * scale, (rows - row) * scale) for row, col in places]

    if scan is not None:
        hits = scan_hits(grid, scan, pose, radius_m)
        _dots(draw, pixels(zip(hits.rows + 0.5, hits.cols + 0.5, strict=True)), HIT_PIXELS, SCAN)
    if len(plan.cells) > 1:
        draw.line(pixels(plan.cells + 0.5), fill=PATH, width=PATH_PIXELS, joint="curve")
    (there_xy,) = pixels([grid.position(goal.x, goal.y)])
    _cross(draw, there_xy, MARK_PIXELS)
    radius = max(MARK_PIXELS, radius_m / grid.resolution * scale)
    (here,) = pixels([grid.position(pose.x, pose.y)])
    _robot(draw, here, radius, pose.yaw - grid.origin[2])
    _legend(draw, size[1])
    file = io.BytesIO()
    picture.save(file, "PNG", optimize=True)
    return file.getvalue()


def _colours(cells: NDArray[np.int8]) -> NDArray[np.uint8]:
    """Each cell as a colour, in the order of the rows of the map."""
    found = np.full((*cells.shape, 3), WHITE, np.uint8)
    found[cells < FREE] = GREY
    found[cells >= OCCUPIED] = BLACK
    return found


def _dots(draw: "ImageDraw", places: Iterable[tuple[float, float]], radius: float, colour: Colour) -> None:
    for x, y in places:
        draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=colour)


def _cross(draw: "ImageDraw", place: tuple[float, float], reach: float) -> None:
    x, y = place
    for turned in (-reach, reach):
        draw.line((x - reach, y - turned, x + reach, y + turned), fill=GOAL, width=PATH_PIXELS)


def _robot(draw: "ImageDraw", place: tuple[float, float], radius: float, yaw: float) -> None:
    """A disc with a line that shows where the robot looks."""
    (x, y), ahead = place, 2 * radius
    _dots(draw, [place], radius, ROBOT)
    draw.line((x, y, x + ahead * math.cos(yaw), y - ahead * math.sin(yaw)), fill=ROBOT, width=PATH_PIXELS)


def _legend(draw: "ImageDraw", top: int) -> None:
    """Name each colour, in a line below the map."""
    from PIL import ImageFont

    font, middle, x = ImageFont.load_default(FONT_PIXELS), top + LEGEND_PIXELS / 2, LEGEND_PIXELS / 2
    for name, colour in LEGEND:
        _dots(draw, [(x, middle)], MARK_PIXELS, colour)
        x += 2 * MARK_PIXELS
        draw.text((x, middle), name, fill=BLACK, font=font, anchor="lm")
        x += draw.textlength(name, font=font) + LEGEND_PIXELS
