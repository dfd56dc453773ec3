"""The messages of ROS 2 for cyclonedds, with the names that they have on DDS.

Only `bridge` uses them.
"""

# mypy: disable-error-code="call-arg, misc"
# cyclonedds has no types, so mypy takes each base class for Any.

from dataclasses import dataclass

from offboard.common.errors import MissingExtra

try:
    from cyclonedds.idl import IdlStruct
    from cyclonedds.idl.types import array, byte, float32, float64, int8, int32, sequence, uint32
except ImportError as error:
    raise MissingExtra("a bridge without ROS", "dds") from error


@dataclass
class Time(IdlStruct, typename="builtin_interfaces.msg.dds_.Time_"):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs.msg.dds_.Header_"):
    stamp: Time
    frame_id: str


@dataclass
class Point(IdlStruct, typename="geometry_msgs.msg.dds_.Point_"):
    x: float64
    y: float64
    z: float64


@dataclass
class Quaternion(IdlStruct, typename="geometry_msgs.msg.dds_.Quaternion_"):
    x: float64
    y: float64
    z: float64
    w: float64


@dataclass
class Pose(IdlStruct, typename="geometry_msgs.msg.dds_.Pose_"):
    position: Point
    orientation: Quaternion


@dataclass
class PoseStamped(IdlStruct, typename="geometry_msgs.msg.dds_.PoseStamped_"):
    header: Header
    pose: Pose


@dataclass
class PoseWithCovariance(IdlStruct, typename="geometry_msgs.msg.dds_.PoseWithCovariance_"):
    pose: Pose
    covariance: array[float64, 36]


@dataclass
class PoseWithCovarianceStamped(IdlStruct, typename="geometry_msgs.msg.dds_.PoseWithCovarianceStamped_"):
    header: Header
    pose: PoseWithCovariance


@dataclass
class LaserScan(IdlStruct, typename="sensor_msgs.msg.dds_.LaserScan_"):
    header: Header
    angle_min: float32
    angle_max: float32
    angle_increment: float32
    time_increment: float32
    scan_time: float32
    range_min: float32
    range_max: float32
    ranges: sequence[float32]
    intensities: sequence[float32]


@dataclass
class MapMetaData(IdlStruct, typename="nav_msgs.msg.dds_.MapMetaData_"):
    map_load_time: Time
    resolution: float32
    width: uint32
    height: uint32
    origin: Pose


@dataclass
class OccupancyGrid(IdlStruct, typename="nav_msgs.msg.dds_.OccupancyGrid_"):
    header: Header
    info: MapMetaData
    data: sequence[int8]


@dataclass
class Path(IdlStruct, typename="nav_msgs.msg.dds_.Path_"):
    header: Header
    poses: sequence[PoseStamped]


@dataclass
class KeyValue(IdlStruct, typename="diagnostic_msgs.msg.dds_.KeyValue_"):
    key: str
    value: str


@dataclass
class DiagnosticStatus(IdlStruct, typename="diagnostic_msgs.msg.dds_.DiagnosticStatus_"):
    level: byte
    name: str
    message: str
    hardware_id: str
    values: sequence[KeyValue]


@dataclass
class DiagnosticArray(IdlStruct, typename="diagnostic_msgs.msg.dds_.DiagnosticArray_"):
    header: Header
    status: sequence[DiagnosticStatus]


TYPES = {
    f"{package}/msg/{kind.__name__}": kind
    for package, kinds in {
        "builtin_interfaces": (Time,),
        "std_msgs": (Header,),
        "geometry_msgs": (
            Point,
            Quaternion,
            Pose,
            PoseStamped,
            PoseWithCovariance,
            PoseWithCovarianceStamped,
        ),
        "sensor_msgs": (LaserScan,),
        "nav_msgs": (MapMetaData, OccupancyGrid, Path),
        "diagnostic_msgs": (KeyValue, DiagnosticStatus, DiagnosticArray),
    }.items()
    for kind in kinds
}
