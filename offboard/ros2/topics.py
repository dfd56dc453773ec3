"""What the messages of each topic mean to the planner server, whatever library carries them.

`node` carries them with rclpy, `bridge` with cyclonedds.
"""

import logging
import threading
from collections import Counter, deque
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from offboard.common.planning.planner import Pose
from offboard.common.wording import duration
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.policies import Outlook
from offboard.robot_client.records.record import Record
from offboard.robot_client.sites.runner import ONBOARD
from offboard.ros2 import converters as ros
from offboard.ros2.parameters import Parameters
from offboard.ros2.planner_server import ABORTED, Goal, Outcome, PendingGoal, PlannerServer
from offboard.ros2.world import World

NAME = "planner_server"
SAME = Pose(0.0, 0.0)
SHARE_TASKS = 100  # the share of each site is that of the last tasks
OK, WARN = 0, 1  # levels of diagnostic_msgs/DiagnosticStatus

log = logging.getLogger(__name__)


class Transforms(Protocol):
    """Knows where frames are."""

    def of(self, frame: str, seen_from: str) -> Pose | None:
        """The pose of a frame in another one; None if it is unknown."""


class SameFrames:
    """Knows only that a frame is where it is."""

    def of(self, frame: str, seen_from: str) -> Pose | None:
        return SAME if frame == seen_from else None


class Topics:
    """The planner server and its world, told of by messages. One thread calls all methods but `path`."""

    def __init__(
        self,
        library: ros.Library,
        offload: Offloader,
        *,
        parameters: Parameters,
        facts: "Diagnostics",
        transforms: Transforms,
    ) -> None:
        self._library = library
        self._map_frame, self._robot_frame = parameters.frame, parameters.robot_frame
        self._world = World(allow_unknown=parameters.allow_unknown, costmap=parameters.costmap)
        self._planner = PlannerServer(offload, self._world, parameters)
        self._facts = facts
        self._transforms = transforms
        self._warned: set[str] = set()

    def close(self) -> None:
        self._planner.close()

    def see_map(self, message: Any) -> None:
        """An OccupancyGrid."""
        try:
            self._world.see_map(ros.grid_of(message))
        except ValueError as error:
            self._warn(f"a map is ignored: {error}", "correct the node that publishes it")

    def update_map(self, message: Any) -> None:
        """An OccupancyGridUpdate."""
        cells = np.frombuffer(message.data, np.int8)
        fits = cells.size == message.height * message.width
        if not fits or not self._world.update_map(
            message.x, message.y, cells.reshape(message.height, message.width)
        ):
            self._warn("an update does not fit the map, and is ignored", "publish the map before it")

    def see_pose(self, message: Any) -> None:
        """A PoseWithCovarianceStamped or an Odometry; one in another frame says nothing."""
        if message.header.frame_id == self._map_frame:
            self._world.see_pose(ros.pose_of(message.pose.pose))

    def see_scan(self, message: Any) -> None:
        """A LaserScan."""
        frame = message.header.frame_id
        laser = self._transforms.of(frame, self._robot_frame)
        if laser is None:
            self._warn(
                f"scans in frame {frame!r} are ignored: its place on the robot is not known",
                "install tf2_ros",
            )
            return
        scan = ros.scan_of(message)
        self._world.see_scan(scan if laser == SAME else ros.moved_scan(scan, laser))

    def accept(self, goal: Any, start: Any, planner: str, done: Callable[[Outcome], None]) -> PendingGoal:
        """Plan for a PoseStamped from another one, or from the robot (None). `done` is for the planner."""
        robot = self._transforms.of(self._robot_frame, self._map_frame)
        if robot is not None:
            self._world.see_pose(robot)
        end, frame = self._in_map(goal)
        begin, start_frame = (None, "") if start is None else self._in_map(start)
        return self._planner.accept(
            Goal(end, frame, start=begin, start_frame=start_frame, planner=planner), done
        )

    def cancel(self, pending: PendingGoal) -> None:
        self._planner.cancel(pending)

    def path(self, outcome: Outcome, stamp_ns: int) -> Any:
        """The Path of an outcome, which is empty if there is none. Any thread may call this."""
        if outcome.ending == ABORTED:
            log.warning("no plan: %s: %s; remedy: send another goal", outcome.status, outcome.message)
        return ros.path_message(self._library, outcome.poses, ros.Header(self._map_frame, stamp_ns))

    def diagnostics(self, stamp_ns: int) -> Any:
        """A DiagnosticArray with the facts of the offloader."""
        make = self._library.make
        values = [
            make("diagnostic_msgs/msg/KeyValue", key=key, value=value)
            for key, value in self._facts.values().items()
        ]
        status = make(
            "diagnostic_msgs/msg/DiagnosticStatus",
            level=self._library.byte(self._facts.level()),
            name=f"{NAME}: offboard",
            message=self._facts.summary(),
            hardware_id="",
            values=values,
        )
        header = ros.Header("", stamp_ns).message(self._library)
        return make("diagnostic_msgs/msg/DiagnosticArray", header=header, status=[status])

    def _in_map(self, stamped: Any) -> tuple[Pose, str]:
        """A pose in the frame of the map, or in its own frame if that is unknown."""
        pose, frame = ros.pose_of(stamped.pose), stamped.header.frame_id
        place = self._transforms.of(frame, self._map_frame)
        return (pose, frame) if place is None else (ros.moved(pose, place), self._map_frame)

    def _warn(self, text: str, remedy: str) -> None:
        """Say it once: the same thing comes with every message of the topic."""
        if text not in self._warned:
            self._warned.add(text)
            log.warning("%s; remedy: %s", text, remedy)


class Diagnostics:
    """What `/diagnostics` says of an offloader: this observer sums up its last tasks that ended."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._last: Record | None = None
        self._used: deque[str] = deque(maxlen=SHARE_TASKS)

    def __call__(self, record: Record) -> None:
        if record.cancelled:
            return
        with self._lock:
            self._last = record
            self._used.append(record.used or "none")

    def level(self) -> int:
        """WARN while a server gives no answer, or if nothing answered the last task."""
        last = self._last
        if last is None:
            return OK
        silent = any(one.condition.silent for site, one in last.sites.items() if site != ONBOARD)
        return WARN if silent or last.used is None else OK

    def summary(self) -> str:
        """One line: where the last task ran, and how long it took."""
        last = self._last
        return "no task yet" if last is None else f"{last.used or 'no site'}: {duration(last.waited_s)}"

    def values(self) -> dict[str, str]:
        """The facts by name; times in milliseconds."""
        with self._lock:
            last, used = self._last, Counter(self._used)
        if last is None:
            return {}
        found = {
            "site": last.used or "none",
            "reason": last.decision.reason,
            "policy": last.decision.policy,
            "waited_ms": f"{last.waited_s * 1e3:.3f}",
        }
        for site, outlook in last.sites.items():
            found |= _of_site(site, outlook)
        found |= {f"{run.site}.true_ms": f"{run.seconds * 1e3:.3f}" for run in last.executions if run.ok}
        total = used.total()
        return found | {f"{site}.share": f"{used[site] / total:.2f}" for site in last.sites}


def _of_site(site: str, outlook: Outlook) -> dict[str, str]:
    condition, found = outlook.condition, {}
    if outlook.predicted_s is not None:
        found[f"{site}.predicted_ms"] = f"{outlook.predicted_s * 1e3:.3f}"
    if site != ONBOARD:
        found[f"{site}.link"] = "silent" if condition.silent else "answers"
        if condition.round_trip_s is not None:
            found[f"{site}.round_trip_ms"] = f"{condition.round_trip_s * 1e3:.3f}"
    return found
