"""The simulated LiDAR, compared with geometry."""

import math

import numpy as np
import pytest

from offboard.common.planning import planner
from offboard.common.planning.maps import GridMap
from offboard.common.planning.planner import Pose
from offboard.loadgen.robot.robot import cast_scan

planner.warm()
cast_scan(GridMap(np.zeros((4, 4), np.int8), 1.0), Pose(2.0, 2.0))  # compiles before any test's clock


def box_distance(
    x: float, y: float, angle: float, low: tuple[float, float], high: tuple[float, float]
) -> float:
    """The distance at which a ray enters an axis-aligned box, by the slab method; infinity if it misses."""
    near, far = 0.0, math.inf
    for start, step, a, b in zip((x, y), (math.cos(angle), math.sin(angle)), low, high, strict=True):
        if abs(step) < 1e-15:
            if not a <= start <= b:
                return math.inf
            continue
        t = sorted(((a - start) / step, (b - start) / step))
        near, far = max(near, t[0]), min(far, t[1])
    return near if near < far else math.inf


def test_ranges_are_exact_to_the_surface() -> None:
    """From 12 poses among boxes, all 360 ranges match geometry to 0.01 mm."""
    rng = np.random.default_rng(4)
    cells = np.zeros((100, 120), np.int8)
    boxes = [
        (int(r), int(c), int(h), int(w))
        for r, c, h, w in rng.integers((5, 5, 2, 2), (80, 90, 12, 15), (8, 4))
    ]
    for r, c, h, w in boxes:
        cells[r : r + h, c : c + w] = 100
    grid = GridMap(cells, 0.05)
    free = np.argwhere(cells == 0)
    compared = 0
    for row, col in free[rng.integers(len(free), size=12)]:
        pose = Pose((col + rng.random()) * 0.05, (row + rng.random()) * 0.05, rng.uniform(-3, 3))
        scan = cast_scan(grid, pose, range_max=3.0)
        for k, length in enumerate(scan.ranges.tolist()):
            angle = pose.yaw + scan.angle_min + k * scan.angle_increment
            expected = min(
                box_distance(pose.x, pose.y, angle, (c * 0.05, r * 0.05), ((c + w) * 0.05, (r + h) * 0.05))
                for r, c, h, w in boxes
            )
            if expected >= 3.0:
                assert length == math.inf or length >= 3.0 - 1e-5
            else:
                assert length == pytest.approx(expected, abs=1e-5), (pose, k)
                compared += 1
    assert compared > 500


@pytest.mark.parametrize("yaw", [0.0, 0.9])
def test_the_origin_of_the_map_counts(yaw: float) -> None:
    """On a turned and moved map, the beam straight ahead meets the same wall."""
    cells = np.zeros((20, 40), np.int8)
    cells[:, 30] = 100
    grid = GridMap(cells, 0.1, (5.0, -3.0, yaw))
    x, y = grid.metres(np.array([[10, 10]], np.int32))[0]
    scan = cast_scan(grid, Pose(float(x), float(y), yaw), beams=4)
    assert scan.ranges.tolist() == [pytest.approx(1.95, abs=1e-6), math.inf, math.inf, math.inf]


def test_unknown_cells_and_the_edge_return_nothing() -> None:
    """Beams pass through unknown cells, and end at the edge of the map without a hit."""
    cells = np.full((9, 9), -1, np.int8)
    assert not np.isfinite(cast_scan(GridMap(cells, 1.0), Pose(4.5, 4.5)).ranges).any()


def test_a_scan_is_one_turn() -> None:
    """A scan has 360 float32 ranges at equal angles."""
    scan = cast_scan(GridMap(np.zeros((9, 9), np.int8), 1.0), Pose(4.5, 4.5))
    assert scan.ranges.shape == (360,)
    assert scan.ranges.dtype == np.float32
    assert scan.angle_increment * 360 == pytest.approx(2 * math.pi)
