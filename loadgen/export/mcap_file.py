"""An MCAP file of ROS 2 messages in CDR (profile `ros2`), and the topics of a recorded run in it.

Foxglove, Rerun and `ros2 bag` read it; docs/formats.md lists the topics. A message has the time when the
robot knew what it says: the beginning of a task, or its end. Only this file imports mcap and rosbags.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import IO, Any

from offboard.common.errors import ConfigError, MissingExtra
from offboard.common.planning.planner import Pose
from offboard.common.wording import duration
from offboard.loadgen.export.recording import Asked, Decided, Recording, plan_of
from offboard.ros2.converters import (
    Header,
    Library,
    grid_message,
    path_message,
    poses_along,
    scan_message,
    stamped_pose,
)

try:
    from mcap.writer import Writer
    from rosbags.typesys import Stores, get_typestore
except ImportError as error:
    raise MissingExtra("--mcap", "mcap") from error

MAP_FRAME, ROBOT_FRAME = "map", "base_link"
OK, WARN = 0, 1  # levels of diagnostic_msgs/DiagnosticStatus
OURS = "/offboard"


class McapFile:
    """Writes messages by topic, in the order of their stamps. `count` is the number of messages so far."""

    def __init__(self, file: IO[bytes]) -> None:
        self.count = 0
        self._types = get_typestore(Stores.ROS2_JAZZY)
        self.library = Library(self._types.types.__getitem__, lambda values: values)
        self._writer = Writer(file)
        self._writer.start(profile="ros2", library="offboard")
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}

    def write(self, topic: str, message: Any, stamp_ns: int) -> None:
        """Add a message that was made with `library`. All messages of a topic have one type."""
        name = message.__msgtype__
        if topic not in self._channels:
            self._channels[topic] = self._writer.register_channel(
                topic=topic, message_encoding="cdr", schema_id=self._schema(name)
            )
        data = bytes(self._types.serialize_cdr(message, name))
        self._writer.add_message(self._channels[topic], stamp_ns, data, publish_time=stamp_ns)
        self.count += 1

    def finish(self) -> None:
        self._writer.finish()

    def _schema(self, name: str) -> int:
        if name not in self._schemas:
            text, _ = self._types.generate_msgdef(name, ros_version=2)
            self._schemas[name] = self._writer.register_schema(name, "ros2msg", data=text.encode())
        return self._schemas[name]


@contextmanager
def new_mcap(path: Path) -> Iterator[McapFile]:
    """A file that is at `path` once it is whole; after an error nothing is left of it."""
    fresh = path.with_name(f".{path.name}.new")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with fresh.open("wb") as file:
                mcap = McapFile(file)
                yield mcap
                mcap.finish()
            fresh.replace(path)
        finally:
            fresh.unlink(missing_ok=True)
    except OSError as error:
        raise ConfigError(f"--mcap: {path} cannot be written: {error.strerror}") from error


def write_recording(file: McapFile, recording: Recording) -> None:
    """Write the map and all tasks, in the order of time."""
    moments = [(task.begin_ns, partial(write_question, file, task)) for task in recording.tasks]
    moments += [(task.end_ns, partial(write_answer, file, task)) for task in recording.tasks]
    moments.sort(key=itemgetter(0))
    first_ns = moments[0][0]
    file.write("/map", grid_message(file.library, recording.grid, Header(MAP_FRAME, first_ns)), first_ns)
    for _, write in moments:
        write()


def write_question(file: McapFile, task: Asked) -> None:
    """Where the robot was and what it saw, where it wanted to go, and what was predicted."""
    library, at = file.library, task.begin_ns
    _, scan, pose, goal, *_ = task.request
    on_map = Header(MAP_FRAME, at)
    file.write("/tf", transform(library, pose, on_map), at)
    file.write("/scan", scan_message(library, scan, Header(ROBOT_FRAME, at)), at)
    file.write("/pose", stamped_pose(library, pose, on_map), at)
    file.write("/goal_pose", stamped_pose(library, Pose(goal.x, goal.y), on_map), at)
    for site, ms in task.decided.predicted_ms.items():
        file.write(f"{OURS}/predicted_ms/{site}", number(library, ms), at)


def write_answer(file: McapFile, task: Asked) -> None:
    """The path, which is empty if there is none; what was decided; and how long everything took."""
    library, at = file.library, task.end_ns
    grid, _, pose, goal, *_ = task.request
    plan = plan_of(task.line, grid)
    if plan is not None:
        poses = poses_along(plan.metres, pose, Pose(goal.x, goal.y))
        file.write("/plan", path_message(library, poses, Header(MAP_FRAME, at)), at)
    file.write("/diagnostics", diagnostics(library, task.decided, at), at)
    for site, ms in task.decided.true_ms.items():
        file.write(f"{OURS}/true_ms/{site}", number(library, ms), at)
    file.write(f"{OURS}/waited_ms", number(library, task.decided.waited_ms), at)


def diagnostics(library: Library, decided: Decided, stamp_ns: int) -> Any:
    """A diagnostic_msgs/DiagnosticArray: the decision, and what came of it."""
    make, used = library.make, decided.used
    values = {
        "site": used or "none",
        "decided": decided.site,
        "reason": decided.reason,
        "policy": decided.policy,
        "size": str(decided.size),
        "waited_ms": f"{decided.waited_ms:.3f}",
        **{f"{site}.predicted_ms": f"{ms:.3f}" for site, ms in decided.predicted_ms.items()},
        **{f"{site}.true_ms": f"{ms:.3f}" for site, ms in decided.true_ms.items()},
    }
    status = make(
        "diagnostic_msgs/msg/DiagnosticStatus",
        level=library.byte(WARN if used is None else OK),
        name="offboard",
        message=f"{used or 'no site'}: {duration(decided.waited_ms / 1e3)}",
        hardware_id="",
        values=[make("diagnostic_msgs/msg/KeyValue", key=key, value=value) for key, value in values.items()],
    )
    header = Header("", stamp_ns).message(library)
    return make("diagnostic_msgs/msg/DiagnosticArray", header=header, status=[status])


def transform(library: Library, pose: Pose, header: Header) -> Any:
    """Where the robot is, for tools that draw its scan on the map."""
    at = stamped_pose(library, pose, header)
    place = at.pose.position
    moved = library.make(
        "geometry_msgs/msg/Transform",
        translation=library.make("geometry_msgs/msg/Vector3", x=place.x, y=place.y, z=place.z),
        rotation=at.pose.orientation,
    )
    one = library.make(
        "geometry_msgs/msg/TransformStamped", header=at.header, child_frame_id=ROBOT_FRAME, transform=moved
    )
    return library.make("tf2_msgs/msg/TFMessage", transforms=[one])


def number(library: Library, value: float) -> Any:
    """A std_msgs/Float64, which every tool can plot."""
    return library.make("std_msgs/msg/Float64", data=float(value))
