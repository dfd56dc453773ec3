"""The planner server for robots with ROS 2, in a process without ROS: it speaks DDS by cyclonedds.

It has the topics of the node, but not its action. What the messages mean is `topics`.
"""

import contextlib
import logging
import os
import queue
import signal
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from offboard.common.errors import ConfigError, MissingExtra
from offboard.robot_client.offloader import Offloader
from offboard.ros2.converters import Library
from offboard.ros2.parameters import Parameters
from offboard.ros2.planner_server import SUCCEEDED, Outcome
from offboard.ros2.topics import Diagnostics, SameFrames, Topics

try:
    from cyclonedds.core import Listener, Policy, Qos
    from cyclonedds.domain import Domain, DomainParticipant
    from cyclonedds.idl import make_idl_struct
    from cyclonedds.idl.types import array, byte, float32, float64, int8, int32, sequence, uint32
    from cyclonedds.pub import DataWriter
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic
    from cyclonedds.util import duration
except ImportError as error:
    raise MissingExtra("a bridge without ROS", "dds") from error

# The type information of Fast DDS differs from ours although the types are the same; 1.15 is its vendor id.
# Where ROS is limited to its computer (ROS_AUTOMATIC_DISCOVERY_RANGE), it listens to no multicast, so the
# bridge also calls at the ports of the first participants there.
SETTINGS = """
<CycloneDDS><Domain id="any">
  <Compatibility><IgnoreTypeInformation>1.15</IgnoreTypeInformation></Compatibility>
  <Discovery>
    <ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>
    <Peers><Peer Address="localhost"/></Peers>
  </Discovery>
</Domain></CycloneDDS>
"""
DOMAIN_MAX = 232
DIAGNOSTICS_EVERY_S = 1.0
WAITING_MAX = 1000  # messages that were read and have not been looked at

RELIABLE = Policy.Reliability.Reliable(duration(seconds=1))
LAST = Policy.History.KeepLast(1)
LATCHED = Qos(RELIABLE, LAST, Policy.Durability.TransientLocal)
NEWEST = Qos(Policy.Reliability.BestEffort, Policy.History.KeepLast(5))
EACH = Qos(RELIABLE, Policy.History.KeepLast(10))

TYPES: dict[str, Any] = {}  # the classes of the messages of ROS


def _message(name: str, /, **fields: Any) -> Any:
    """Make the class of messages with these fields, under the name that they have on DDS."""
    package, _, kind = name.split("/")
    found = TYPES[name] = make_idl_struct(kind, f"{package}.msg.dds_.{kind}_", fields)
    return found


_time = _message("builtin_interfaces/msg/Time", sec=int32, nanosec=uint32)
_header = _message("std_msgs/msg/Header", stamp=_time, frame_id=str)
_point = _message("geometry_msgs/msg/Point", x=float64, y=float64, z=float64)
_quaternion = _message("geometry_msgs/msg/Quaternion", x=float64, y=float64, z=float64, w=float64)
_pose = _message("geometry_msgs/msg/Pose", position=_point, orientation=_quaternion)
_stamped = _message("geometry_msgs/msg/PoseStamped", header=_header, pose=_pose)
_uncertain = _message("geometry_msgs/msg/PoseWithCovariance", pose=_pose, covariance=array[float64, 36])
_message("geometry_msgs/msg/PoseWithCovarianceStamped", header=_header, pose=_uncertain)
_message(
    "sensor_msgs/msg/LaserScan",
    header=_header,
    angle_min=float32,
    angle_max=float32,
    angle_increment=float32,
    time_increment=float32,
    scan_time=float32,
    range_min=float32,
    range_max=float32,
    ranges=sequence[float32],
    intensities=sequence[float32],
)
_info = _message(
    "nav_msgs/msg/MapMetaData",
    map_load_time=_time,
    resolution=float32,
    width=uint32,
    height=uint32,
    origin=_pose,
)
_message("nav_msgs/msg/OccupancyGrid", header=_header, info=_info, data=sequence[int8])
_message("nav_msgs/msg/Path", header=_header, poses=sequence[_stamped])
_value = _message("diagnostic_msgs/msg/KeyValue", key=str, value=str)
_status = _message(
    "diagnostic_msgs/msg/DiagnosticStatus",
    level=byte,
    name=str,
    message=str,
    hardware_id=str,
    values=sequence[_value],
)
_message("diagnostic_msgs/msg/DiagnosticArray", header=_header, status=sequence[_status])

DDS = Library(TYPES.__getitem__, lambda values: values.tolist())

log = logging.getLogger(__name__)


class Bridge:
    """Reads and writes the topics of ROS. One thread, `run`, handles all messages."""

    def __init__(self, domain_id: int) -> None:
        self._domain = Domain(domain_id, SETTINGS)  # its settings last as long as this reference
        self._participant = DomainParticipant(domain_id)
        self._work: queue.Queue[Callable[[], None]] = queue.Queue(WAITING_MAX)
        self._readers: list[Any] = []
        self._plans = self._writer("nav_msgs/msg/Path", "plan")
        self._diagnostics = self._writer("diagnostic_msgs/msg/DiagnosticArray", "diagnostics")

    def run(self, topics: Topics, parameters: Parameters) -> None:
        """Serve until interrupted."""
        self._read("nav_msgs/msg/OccupancyGrid", parameters.map_topic, LATCHED, topics.see_map)
        pose = "geometry_msgs/msg/PoseWithCovarianceStamped"
        self._read(pose, "amcl_pose", LATCHED, topics.see_pose)
        if parameters.scan_topic and not parameters.costmap:
            self._read("sensor_msgs/msg/LaserScan", parameters.scan_topic, NEWEST, topics.see_scan)

        def done(outcome: Outcome) -> None:
            path = topics.path(outcome, time.time_ns())
            self._work.put(lambda: self._publish(topics, outcome, path))

        self._read(
            "geometry_msgs/msg/PoseStamped",
            "goal_pose",
            EACH,
            lambda message: topics.accept(message, None, "", done),
        )
        log.info("ready: topics goal_pose and plan")
        due_s = time.monotonic()
        while True:
            try:
                self._work.get(timeout=max(0.0, due_s - time.monotonic()))()
            except queue.Empty:
                due_s = time.monotonic() + DIAGNOSTICS_EVERY_S
                self._diagnostics.write(topics.diagnostics(time.time_ns()))

    def _publish(self, topics: Topics, outcome: Outcome, path: Any) -> None:
        if outcome.ending == SUCCEEDED:
            self._plans.write(path)
        self._diagnostics.write(topics.diagnostics(time.time_ns()))

    def _read(self, kind: str, name: str, qos: Any, seen: Callable[[Any], Any]) -> None:
        listener = _Reader(self._work, seen)
        self._readers.append(DataReader(self._participant, self._topic(kind, name), qos, listener))

    def _writer(self, kind: str, name: str) -> Any:
        return DataWriter(self._participant, self._topic(kind, name), EACH)

    def _topic(self, kind: str, name: str) -> Any:
        return Topic(self._participant, f"rt/{name.lstrip('/')}", TYPES[kind])


class _Reader(Listener):  # type: ignore[misc]  # cyclonedds has no types
    """Takes messages in a thread of cyclonedds, and hands them to the thread of the bridge."""

    def __init__(self, work: "queue.Queue[Callable[[], None]]", seen: Callable[[Any], Any]) -> None:
        super().__init__()
        self._work = work
        self._seen = seen

    def on_data_available(self, reader: Any) -> None:
        for message in reader.take(WAITING_MAX):
            if message.sample_info.valid_data:
                self._work.put(partial(self._seen, message))


def serve(offload: Offloader, facts: Diagnostics, parameters: Parameters) -> None:
    """Serve the topics until interrupted."""
    bridge = Bridge(domain_of(os.environ.get("ROS_DOMAIN_ID", "0")))
    topics = Topics(DDS, offload, parameters=parameters, facts=facts, transforms=SameFrames())
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with contextlib.suppress(KeyboardInterrupt):
            bridge.run(topics, parameters)
    finally:
        topics.close()


def domain_of(text: str) -> int:
    """The domain that ROS_DOMAIN_ID names."""
    if not (text.isdecimal() and int(text) <= DOMAIN_MAX):
        raise ConfigError(f"ROS_DOMAIN_ID: {text!r} is not a number from 0 to {DOMAIN_MAX}")
    return int(text)
