"""The picture of a plan: what is drawn where."""

import io
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from offboard.common.errors import ConfigError
from offboard.common.planning.maps import OCCUPIED, UNKNOWN, GridMap
from offboard.common.planning.planner import Plan, Point, Pose, plan_path
from offboard.loadgen.__main__ import main
from offboard.loadgen.map_picture import (
    BLACK,
    GOAL,
    GREY,
    LEGEND_PIXELS,
    PATH,
    ROBOT,
    SCAN,
    SIDE_PIXELS,
    WHITE,
    LastPlan,
    draw_plan,
)
from offboard.loadgen.robot.robot import Request, cast_scan

SIDE, RESOLUTION = 60, 0.1
ROOT = Path(__file__).parents[2]
MAPS = ROOT / "maps"

pytestmark = pytest.mark.timeout(90)  # the first plan compiles the planner


def a_plan() -> tuple[Request, Plan]:
    """A robot at the lower left looks up; a box that is not on its map stands above it; its goal is right."""
    cells = np.zeros((SIDE, SIDE), np.int8)
    cells[0, :] = OCCUPIED
    cells[-6:, :] = UNKNOWN
    grid = GridMap(cells, RESOLUTION)
    world = cells.copy()
    world[30:34, 8:14] = OCCUPIED
    pose, goal = Pose(1.0, 1.0, math.pi / 2), Point(5.0, 1.5)
    scan = cast_scan(GridMap(world, RESOLUTION), pose)
    request: Request = (grid, scan, pose, goal, 0.15, None, "dijkstra")
    return request, plan_path(grid, scan, pose, goal, 0.15)


def drawn() -> NDArray[np.uint8]:
    (grid, scan, pose, goal, radius_m, _, _), plan = a_plan()
    png = draw_plan(grid, plan, scan=scan, pose=pose, goal=goal, radius_m=radius_m)
    return np.asarray(Image.open(io.BytesIO(png)))


def at(picture: NDArray[np.uint8], x: float, y: float) -> tuple[int, ...]:
    """The colour at a place of the map, in m."""
    pixels = SIDE_PIXELS / (SIDE * RESOLUTION)
    return tuple(map(int, picture[round(SIDE_PIXELS - y * pixels), round(x * pixels)]))


def test_the_map_is_drawn_with_higher_y_further_up() -> None:
    """The wall at the lower edge is black, the unknown strip at the upper edge grey, the rest white."""
    picture = drawn()
    assert picture.shape == (SIDE_PIXELS + LEGEND_PIXELS, SIDE_PIXELS, 3)
    assert at(picture, 5.5, 0.05) == BLACK
    assert at(picture, 5.5, 5.8) == GREY
    assert at(picture, 5.5, 4.0) == WHITE


def test_robot_goal_path_and_scan_are_where_they_are() -> None:
    """Robot, its direction, goal, path and the lower side of the box have their colours."""
    picture = drawn()
    assert at(picture, 1.0, 1.0) == ROBOT
    assert at(picture, 1.0, 1.25) == ROBOT
    assert at(picture, 5.0, 1.5) == GOAL
    seen = np.argwhere((picture[:SIDE_PIXELS] == SCAN).all(axis=2))
    pixels = SIDE_PIXELS / SIDE
    box = seen[(seen[:, 0] > SIDE_PIXELS - 34 * pixels) & (seen[:, 0] < SIDE_PIXELS - 29 * pixels)]
    assert len(box)
    (_, _, _, _, _, _, _), plan = a_plan()
    row, col = plan.cells[len(plan.cells) // 2]
    assert at(picture, (col + 0.5) * RESOLUTION, (row + 0.5) * RESOLUTION) == PATH


def test_the_legend_names_each_colour() -> None:
    """The strip below the map holds every colour of the legend and text."""
    legend = drawn()[SIDE_PIXELS:].reshape(-1, 3)
    for colour in (ROBOT, GOAL, PATH, SCAN, BLACK, GREY):
        assert (legend == colour).all(axis=1).any(), colour


def test_the_last_plan_with_a_path_is_drawn(tmp_path: Path) -> None:
    """A later plan without a path, and a task without an answer, do not replace it."""
    request, plan = a_plan()
    last = LastPlan(tmp_path / "new" / "plan.png")
    assert last.write().endswith("is not drawn: no plan found a path")
    last.keep(request, plan)
    none = Plan("NO_VALID_PATH", plan.cells[:0], plan.metres[:0], cost=0.0, expanded=0)
    last.keep(request, none)
    last.keep(request, None)
    assert last.write() == f"picture of the last plan: {tmp_path / 'new' / 'plan.png'}"
    with Image.open(tmp_path / "new" / "plan.png") as picture:
        assert picture.width == SIDE_PIXELS


def test_a_picture_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    """The error names the flag and the file."""
    (tmp_path / "file").touch()
    last = LastPlan(tmp_path / "file" / "plan.png")
    last.keep(*a_plan())
    with pytest.raises(ConfigError, match=r"--picture: .*plan\.png cannot be written: "):
        last.write()


def test_a_robot_draws_its_last_plan(tmp_path: Path) -> None:
    """`loadgen drive --picture` needs no server; it says where the picture is."""
    path = tmp_path / "plan.png"
    command = [sys.executable, "-m", "offboard.loadgen", "drive", "--tasks", "3", "--picture", str(path)]
    command += ["--map", str(MAPS / "depot.yaml")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.endswith(f"picture of the last plan: {path}\n")
    with Image.open(path) as picture:
        colours = np.asarray(picture.convert("RGB")).reshape(-1, 3)
    for colour in (ROBOT, GOAL, PATH, SCAN, BLACK):
        assert (colours == colour).all(axis=1).any(), colour


def test_a_picture_is_a_png(capsys: pytest.CaptureFixture[str]) -> None:
    """Another ending is refused before the run."""
    assert main(["drive", "--map", str(MAPS / "depot.yaml"), "--picture", "plan.jpg"]) == 2
    assert capsys.readouterr().err == "loadgen drive: --picture: plan.jpg must end with .png\n"
