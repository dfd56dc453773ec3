"""Converts between numpy arrays and messages of ROS 2: Image, PointCloud2, LaserScan, OccupancyGrid, Path.

Only the fields of the messages matter here, and no library of ROS is imported. `Library` says where message
classes come from: rclpy, rosbags and cyclonedds each have their own.
"""

import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.common.planning.maps import GridMap
from offboard.common.planning.planner import BEAMS_MAX, Pose, Scan

# Encodings of sensor_msgs/Image: type of a number, and numbers per pixel.
ENCODINGS: Mapping[str, tuple[str, int]] = {
    "mono8": ("u1", 1),
    "8UC1": ("u1", 1),
    "rgb8": ("u1", 3),
    "bgr8": ("u1", 3),
    "8UC3": ("u1", 3),
    "rgba8": ("u1", 4),
    "bgra8": ("u1", 4),
    "mono16": ("u2", 1),
    "16UC1": ("u2", 1),
    "32FC1": ("f4", 1),
}
# Types of sensor_msgs/PointField by their number.
POINT_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
FLOAT32 = 7
MOVED_FINER = 4


@dataclass(frozen=True, slots=True)
class Library:
    """Where message classes come from.

    `find` returns the class of a name such as `nav_msgs/msg/Path`; its constructor takes the fields by name.
    `numbers` turns an array into what a field of many numbers takes, and `byte` a number into a field of type
    byte.
    """

    find: Callable[[str], Callable[..., Any]]
    numbers: Callable[[NDArray[Any]], Any]
    byte: Callable[[int], Any] = int

    def make(self, name: str, /, **fields: Any) -> Any:
        return self.find(name)(**fields)


@dataclass(frozen=True, slots=True)
class Header:
    """The frame and the time of a message, in nanoseconds since the epoch of its clock."""

    frame: str
    stamp_ns: int = 0

    def message(self, library: Library) -> Any:
        sec, nanosec = divmod(self.stamp_ns, 1_000_000_000)
        stamp = library.make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
        return library.make("std_msgs/msg/Header", stamp=stamp, frame_id=self.frame)


def header_of(message: Any) -> Header:
    """The header of any message that has one."""
    stamp = message.header.stamp
    return Header(message.header.frame_id, stamp.sec * 1_000_000_000 + stamp.nanosec)


def image_array(message: Any) -> NDArray[Any]:
    """A sensor_msgs/Image as rows x columns, or rows x columns x channels.

    It shares the memory of the message if its rows have no padding and its byte order is that of the machine.
    """
    if message.encoding not in ENCODINGS:
        raise ValueError(f"image encoding {message.encoding!r}; known: {', '.join(ENCODINGS)}")
    kind, channels = ENCODINGS[message.encoding]
    dtype = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
    height, width, used = message.height, message.width, message.width * channels * dtype.itemsize
    if message.step < used:
        raise ValueError(f"image rows of {message.step} bytes; {width} pixels need {used}")
    data = _numbers(message.data, np.uint8)
    if data.size < height * message.step:
        raise ValueError(
            f"image of {data.size} bytes; {height} rows of {message.step} bytes are missing some"
        )
    rows = data[: height * message.step].reshape(height, message.step)[:, :used]
    array = np.ascontiguousarray(rows).view(dtype).astype(dtype.newbyteorder("="), copy=False)
    return array.reshape((height, width) if channels == 1 else (height, width, channels))


def image_message(library: Library, array: NDArray[Any], encoding: str, header: Header) -> Any:
    """A sensor_msgs/Image of an array as `image_array` returns it."""
    kind, channels = ENCODINGS[encoding]
    shape = array.shape if array.ndim == 3 else (*array.shape, 1)
    if array.dtype != np.dtype(kind) or shape[2:] != (channels,):
        raise ValueError(f"image of {array.dtype} {array.shape}; {encoding} is {np.dtype(kind)} x {channels}")
    raw = np.ascontiguousarray(array)
    return library.make(
        "sensor_msgs/msg/Image",
        header=header.message(library),
        height=shape[0],
        width=shape[1],
        encoding=encoding,
        is_bigendian=int(sys.byteorder == "big"),
        step=raw.nbytes // shape[0] if shape[0] else 0,
        data=library.numbers(raw.reshape(-1).view(np.uint8)),
    )


def cloud_points(message: Any, fields: tuple[str, ...] = ("x", "y", "z")) -> NDArray[np.float32]:
    """The named fields of a sensor_msgs/PointCloud2, one row for each point.

    Points where one of these fields is not finite are left out.
    """
    known = {field.name: field for field in message.fields}
    if missing := [name for name in fields if name not in known]:
        raise ValueError(f"point field {missing[0]!r}; the cloud has {', '.join(known)}")
    order = ">" if message.is_bigendian else "<"
    layout = np.dtype(
        {
            "names": list(fields),
            "formats": [order + POINT_TYPES[known[name].datatype] for name in fields],
            "offsets": [known[name].offset for name in fields],
            "itemsize": message.point_step,
        }
    )
    data = _numbers(message.data, np.uint8)
    used = message.width * message.point_step
    rows = data[: message.height * message.row_step].reshape(message.height, message.row_step)[:, :used]
    points = np.ascontiguousarray(rows).reshape(-1).view(layout)
    columns = np.stack([points[name].astype(np.float32) for name in fields], axis=1)
    return columns[np.isfinite(columns).all(axis=1)]


def cloud_message(
    library: Library,
    points: NDArray[np.float32],
    header: Header,
    fields: tuple[str, ...] = ("x", "y", "z"),
) -> Any:
    """A sensor_msgs/PointCloud2 of float32 fields, from one row for each point."""
    raw = np.ascontiguousarray(points, np.dtype("<f4"))
    if raw.ndim != 2 or raw.shape[1] != len(fields):
        raise ValueError(f"points are {points.shape}; they must have {len(fields)} columns")
    step = 4 * len(fields)
    described = [
        library.make("sensor_msgs/msg/PointField", name=name, offset=4 * place, datatype=FLOAT32, count=1)
        for place, name in enumerate(fields)
    ]
    return library.make(
        "sensor_msgs/msg/PointCloud2",
        header=header.message(library),
        height=1,
        width=len(raw),
        fields=described,
        is_bigendian=False,
        point_step=step,
        row_step=step * len(raw),
        data=library.numbers(raw.reshape(-1).view(np.uint8)),
        is_dense=bool(np.isfinite(raw).all()),
    )


def scan_of(message: Any) -> Scan:
    """A sensor_msgs/LaserScan as a scan of the planner: beams below `range_min` have seen nothing."""
    ranges = _numbers(message.ranges, np.float32).copy()
    ranges[ranges < message.range_min] = np.inf
    return Scan(ranges, message.angle_min, message.angle_increment, message.range_max)


def scan_message(library: Library, scan: Scan, header: Header) -> Any:
    """A sensor_msgs/LaserScan; all its beams are taken as measured at once."""
    return library.make(
        "sensor_msgs/msg/LaserScan",
        header=header.message(library),
        angle_min=float(scan.angle_min),
        angle_max=float(scan.angle_min + scan.angle_increment * max(0, scan.ranges.size - 1)),
        angle_increment=float(scan.angle_increment),
        time_increment=0.0,
        scan_time=0.0,
        range_min=0.0,
        range_max=float(scan.range_max),
        ranges=library.numbers(scan.ranges.astype(np.float32)),
        intensities=library.numbers(np.zeros(0, np.float32)),
    )


def grid_of(message: Any) -> GridMap:
    """A nav_msgs/OccupancyGrid as a map of the planner, with a copy of its cells."""
    info = message.info
    cells = _numbers(message.data, np.int8)
    if cells.size != info.height * info.width:
        raise ValueError(f"grid of {cells.size} cells; {info.width} x {info.height} are announced")
    pose = pose_of(info.origin)
    resolution = round(float(info.resolution), 7)  # a float32 in the message: 0.05 arrives as 0.0500000007
    return GridMap(cells.reshape(info.height, info.width).copy(), resolution, (pose.x, pose.y, pose.yaw))


def grid_message(library: Library, grid: GridMap, header: Header) -> Any:
    """A nav_msgs/OccupancyGrid; its map was loaded at the time of the header."""
    made = header.message(library)
    info = library.make(
        "nav_msgs/msg/MapMetaData",
        map_load_time=made.stamp,
        resolution=float(grid.resolution),
        width=grid.cells.shape[1],
        height=grid.cells.shape[0],
        origin=pose_message(library, Pose(*grid.origin)),
    )
    cells = library.numbers(grid.cells.reshape(-1))
    return library.make("nav_msgs/msg/OccupancyGrid", header=made, info=info, data=cells)


def moved(pose: Pose, frame: Pose) -> Pose:
    """A pose that is given in a frame, in the frame in which that frame is given."""
    cos, sin = math.cos(frame.yaw), math.sin(frame.yaw)
    x, y = frame.x + pose.x * cos - pose.y * sin, frame.y + pose.x * sin + pose.y * cos
    return Pose(x, y, pose.yaw + frame.yaw)


def moved_scan(scan: Scan, laser: Pose) -> Scan:
    """A scan of a laser at this pose of the robot, as the robot itself would have seen it.

    Hits are put into beams that are MOVED_FINER times finer; the nearest hit of a beam counts.
    """
    beams = np.flatnonzero(np.isfinite(scan.ranges) & (scan.ranges >= 0) & (scan.ranges < scan.range_max))
    angles = laser.yaw + scan.angle_min + scan.angle_increment * beams
    x = laser.x + scan.ranges[beams] * np.cos(angles)
    y = laser.y + scan.ranges[beams] * np.sin(angles)
    count = min(BEAMS_MAX, MOVED_FINER * max(1, scan.ranges.size))
    step = 2 * math.pi / count
    ranges = np.full(count, np.inf, np.float32)
    places = np.round((np.arctan2(y, x) + math.pi) / step).astype(np.int64) % count
    np.minimum.at(ranges, places, np.hypot(x, y).astype(np.float32))
    reach = scan.range_max + math.hypot(laser.x, laser.y)
    return Scan(ranges, -math.pi, step, reach)


def pose_of(message: Any) -> Pose:
    """A geometry_msgs/Pose on the floor: its place and its yaw."""
    turn = message.orientation
    yaw = math.atan2(
        2 * (turn.w * turn.z + turn.x * turn.y), 1 - 2 * (turn.y * turn.y + turn.z * turn.z)
    )  # fmt: skip
    return Pose(message.position.x, message.position.y, yaw)


def pose_message(library: Library, pose: Pose) -> Any:
    """A geometry_msgs/Pose on the floor."""
    point = library.make("geometry_msgs/msg/Point", x=float(pose.x), y=float(pose.y), z=0.0)
    half = pose.yaw / 2
    turn = library.make(
        "geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=float(math.sin(half)), w=float(math.cos(half))
    )
    return library.make("geometry_msgs/msg/Pose", position=point, orientation=turn)


def stamped_pose(library: Library, pose: Pose, header: Header) -> Any:
    """A geometry_msgs/PoseStamped on the floor."""
    return library.make(
        "geometry_msgs/msg/PoseStamped", header=header.message(library), pose=pose_message(library, pose)
    )


def path_poses(message: Any) -> NDArray[np.float64]:
    """The poses of a nav_msgs/Path as rows of x, y and yaw."""
    poses = [pose_of(stamped.pose) for stamped in message.poses]
    return np.array([(pose.x, pose.y, pose.yaw) for pose in poses], np.float64).reshape(-1, 3)


def path_message(library: Library, poses: NDArray[np.float64], header: Header) -> Any:
    """A nav_msgs/Path of rows of x, y and yaw."""
    # A path has a thousand poses, so the classes are looked up once, and all poses share one header.
    stamped, posed, point, turn = (
        library.find(f"geometry_msgs/msg/{name}") for name in ("PoseStamped", "Pose", "Point", "Quaternion")
    )
    made = header.message(library)
    halves = poses[:, 2] / 2
    rows = np.stack((poses[:, 0], poses[:, 1], np.sin(halves), np.cos(halves)), axis=1).tolist()
    found = [
        stamped(
            header=made,
            pose=posed(position=point(x=x, y=y, z=0.0), orientation=turn(x=0.0, y=0.0, z=z, w=w)),
        )
        for x, y, z, w in rows
    ]
    return library.make("nav_msgs/msg/Path", header=made, poses=found)


def poses_along(metres: NDArray[np.float32], start: Pose, goal: Pose) -> NDArray[np.float64]:
    """Rows of x, y and yaw: the points of a plan from start to goal, each looking at the next one.

    The first point is replaced by the start and the last one by the goal, which lie somewhere in their cells.
    """
    if not len(metres):
        return np.zeros((0, 3))
    places = metres.astype(np.float64)
    places[0] = start.x, start.y
    places[-1] = goal.x, goal.y
    ahead = np.diff(places, axis=0)
    yaws = np.append(np.arctan2(ahead[:, 1], ahead[:, 0]), goal.yaw)
    return np.column_stack((places, yaws))


def _numbers(data: Any, kind: type) -> NDArray[Any]:
    """The numbers of a field: an array, a buffer (without a copy), or any sequence."""
    if isinstance(data, np.ndarray):
        return data.astype(kind, copy=False)
    try:
        return np.frombuffer(memoryview(data).cast("B"), kind)
    except TypeError:
        return np.asarray(data, kind)
