"""Converters between numpy and messages of ROS 2, without ROS: messages are plain objects here."""

import array
import math
from types import SimpleNamespace

import numpy as np
import pytest

from offboard.common.planning.maps import GridMap
from offboard.common.planning.planner import Pose, Scan
from offboard.ros2 import converters as ros
from offboard.ros2.ros_messages import numbers

PLAIN = ros.Library(lambda name: SimpleNamespace, lambda values: values)  # noqa: ARG005 - one class for all
HEADER = ros.Header("map", 1_700_000_000_123_456_789)


@pytest.mark.parametrize(("encoding", "kind", "shape"), [
    ("mono8", np.uint8, (4, 6)), ("rgb8", np.uint8, (4, 6, 3)), ("bgra8", np.uint8, (4, 6, 4)),
    ("16UC1", np.uint16, (4, 6)), ("32FC1", np.float32, (4, 6)),
])  # fmt: skip
def test_an_image_comes_back_as_it_was(encoding: str, kind: type, shape: tuple[int, ...]) -> None:
    """An array becomes an Image, and the Image becomes the same array, for every kind of pixel."""
    pixels = np.random.default_rng(1).integers(0, 200, shape).astype(kind)
    message = ros.image_message(PLAIN, pixels, encoding, HEADER)
    assert (message.height, message.width, message.step) == (4, 6, pixels.strides[0])
    back = ros.image_array(message)
    assert back.dtype == kind
    np.testing.assert_array_equal(back, pixels)


def test_padding_and_byte_order_of_an_image_are_undone() -> None:
    """Rows may be longer than their pixels, and numbers may have the other byte order."""
    pixels = np.arange(12, dtype=">u2").reshape(3, 4)
    padded = np.zeros((3, 12), np.uint8)
    padded[:, :8] = pixels.view(np.uint8).reshape(3, 8)
    message = SimpleNamespace(
        encoding="mono16", is_bigendian=1, height=3, width=4, step=12, data=array.array("B", padded.tobytes())
    )
    np.testing.assert_array_equal(ros.image_array(message), np.arange(12).reshape(3, 4))


def test_wrong_images_are_refused() -> None:
    """An unknown encoding, missing bytes and an array of the wrong type are errors that say what is wrong."""
    message = ros.image_message(PLAIN, np.zeros((2, 2), np.uint8), "mono8", HEADER)
    message.data = message.data[:3]
    with pytest.raises(ValueError, match="missing"):
        ros.image_array(message)
    message.encoding = "yuv422"
    with pytest.raises(ValueError, match="image encoding 'yuv422'; known: mono8"):
        ros.image_array(message)
    with pytest.raises(ValueError, match="rgb8 is uint8 x 3"):
        ros.image_message(PLAIN, np.zeros((2, 2), np.uint8), "rgb8", HEADER)


def test_a_point_cloud_comes_back_without_the_points_that_have_no_place() -> None:
    """Rows of points become a PointCloud2, and only the finite ones come back."""
    points = np.random.default_rng(2).normal(size=(50, 4)).astype(np.float32)
    message = ros.cloud_message(PLAIN, points, HEADER, ("x", "y", "z", "intensity"))
    np.testing.assert_array_equal(ros.cloud_points(message, ("x", "y", "z", "intensity")), points)
    points[7, 2] = np.nan
    message = ros.cloud_message(PLAIN, points, HEADER, ("x", "y", "z", "intensity"))
    assert not message.is_dense
    assert len(ros.cloud_points(message)) == 49
    with pytest.raises(ValueError, match="point field 'ring'; the cloud has x, y, z, intensity"):
        ros.cloud_points(message, ("ring",))


def test_a_cloud_with_padded_points_of_several_types_is_read() -> None:
    """Offsets, padding between points and rows, and types other than float32 are respected."""
    layout = np.dtype({"names": ["x", "ring"], "formats": ["<f8", "<u2"], "offsets": [4, 16], "itemsize": 24})
    made = np.zeros((2, 3), layout)
    made["x"], made["ring"] = [[1, 2, 3], [4, 5, 6]], [[9, 8, 7], [6, 5, 4]]
    rows = np.zeros((2, 80), np.uint8)
    rows[:, :72] = made.view(np.uint8).reshape(2, 72)
    fields = [
        SimpleNamespace(name="x", offset=4, datatype=8),
        SimpleNamespace(name="ring", offset=16, datatype=4),
    ]
    message = SimpleNamespace(
        fields=fields, is_bigendian=False, point_step=24, row_step=80, height=2, width=3, data=rows.tobytes()
    )
    expected = np.array([[1, 9], [2, 8], [3, 7], [4, 6], [5, 5], [6, 4]])
    np.testing.assert_array_equal(ros.cloud_points(message, ("x", "ring")), expected)


def test_a_scan_comes_back_and_too_near_beams_see_nothing() -> None:
    """A scan becomes a LaserScan and back; a range below `range_min` is no hit."""
    scan = Scan(np.array([0.05, 2.0, np.inf, np.nan], np.float32), -1.0, 0.5, 8.0)
    message = ros.scan_message(PLAIN, scan, HEADER)
    assert (message.angle_min, message.angle_max) == (-1.0, 0.5)
    message.range_min = 0.1
    back = ros.scan_of(message)
    np.testing.assert_array_equal(back.ranges, np.array([np.inf, 2.0, np.inf, np.nan], np.float32))
    assert (back.angle_min, back.angle_increment, back.range_max) == (-1.0, 0.5, 8.0)


def test_a_map_comes_back_with_its_turned_origin() -> None:
    """A map becomes an OccupancyGrid and back, with its resolution as it was before it was a float32."""
    cells = np.random.default_rng(3).integers(-1, 101, (5, 7)).astype(np.int8)
    message = ros.grid_message(PLAIN, GridMap(cells, 0.05, (-3.0, 4.5, 0.7)), HEADER)
    message.info.resolution = float(np.float32(message.info.resolution))
    back = ros.grid_of(message)
    np.testing.assert_array_equal(back.cells, cells)
    assert back.resolution == 0.05
    assert back.origin == pytest.approx((-3.0, 4.5, 0.7))
    message.info.width = 8
    with pytest.raises(ValueError, match="grid of 35 cells; 8 x 5 are announced"):
        ros.grid_of(message)


def test_a_path_comes_back() -> None:
    """Rows of x, y and yaw become a Path and back, all in the frame of its header."""
    poses = np.array([[0.0, 1.0, -3.0], [2.5, -1.0, 0.0], [9.0, 9.0, 1.5]])
    message = ros.path_message(PLAIN, poses, HEADER)
    assert message.poses[2].header.frame_id == "map"
    np.testing.assert_allclose(ros.path_poses(message), poses)
    assert ros.header_of(message) == HEADER
    assert ros.path_poses(ros.path_message(PLAIN, np.zeros((0, 3)), HEADER)).shape == (0, 3)


def test_poses_along_a_plan_look_ahead_and_end_as_the_goal_wants() -> None:
    """Each pose looks at the next one, and the last one has the yaw of the goal."""
    metres = np.array([[0, 0], [1, 0], [1, 1]], np.float32)
    poses = ros.poses_along(metres, Pose(0.1, 0.0, 3.0), Pose(1.0, 1.1, -2.0))
    np.testing.assert_allclose(poses[:, 2], [0.0, math.pi / 2, -2.0])
    np.testing.assert_allclose(poses[[0, 2], :2], [[0.1, 0.0], [1.0, 1.1]])


def test_a_moved_scan_sees_the_same_walls() -> None:
    """Hits of a laser that is mounted elsewhere, and turned, are where they were, within a fine beam."""
    scan = Scan(np.full(90, 3.0, np.float32), 0.0, 2 * math.pi / 90, 10.0)
    laser = Pose(0.4, -0.2, 1.1)
    seen = ros.moved_scan(scan, laser)
    beams = np.flatnonzero(np.isfinite(seen.ranges))
    angles = seen.angle_min + seen.angle_increment * beams
    x, y = seen.ranges[beams] * np.cos(angles), seen.ranges[beams] * np.sin(angles)
    distances = np.hypot(x - laser.x, y - laser.y)
    assert len(beams) == pytest.approx(90, abs=2)
    np.testing.assert_allclose(distances, 3.0, atol=0.02)


def test_numbers_for_ros_keep_their_values() -> None:
    """Arrays become the typed arrays that messages of ROS take without a look at each number."""
    for kind in (np.int8, np.uint8, np.float32):
        values = np.arange(6).astype(kind)
        made = numbers(values[::2])
        assert made.tolist() == [0, 2, 4]
        assert made.itemsize == np.dtype(kind).itemsize
