"""A client of nav2's planner server, in a process and an environment of its own.

It imports nothing of Offboard, so that both sides of every message are written independently. It reads one
JSON command a line from stdin, and answers each with one line. Its argument is the name of the action.
"""

import array
import gc
import json
import math
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped, PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid, Path
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import Image, LaserScan

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
ANSWERS = QoSProfile(depth=100)  # by default, a client drops what it has not read when 10 more have come
WAIT_S = 30.0
TRIES = 10
CODES = (
    *("NONE", "UNKNOWN", "INVALID_PLANNER", "TF_ERROR", "START_OUTSIDE_MAP", "GOAL_OUTSIDE_MAP"),
    *("START_OCCUPIED", "GOAL_OCCUPIED", "TIMEOUT", "NO_VALID_PATH"),
)


class Peer:
    """Publishes what a robot publishes, and asks for paths."""

    def __init__(self) -> None:
        self.node = rclpy.create_node("peer")
        self.plans: deque[tuple[float, Path]] = deque(maxlen=1)  # with the times at which they came
        self.latched: set[Any] = set()  # publishers that have published
        self.facts: dict[str, Any] = {}
        self.maps = self.node.create_publisher(OccupancyGrid, "map", LATCHED)
        self.poses = self.node.create_publisher(PoseWithCovarianceStamped, "amcl_pose", LATCHED)
        self.scans = self.node.create_publisher(LaserScan, "scan", 5)
        self.goal_poses = self.node.create_publisher(PoseStamped, "goal_pose", 10)
        self.node.create_subscription(Path, "plan", self._see_plan, 1)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._see_facts, 10)

    def _see_plan(self, message: Path) -> None:
        self.plans.append((time.perf_counter(), message))

    def _see_facts(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.facts = {one.key: one.value for one in status.values}
            self.facts["level"] = int.from_bytes(status.level, "big")

    def map(self, file: str, resolution: float, origin: list[float], frame: str = "map") -> None:
        """Publish a map from a file of raw int8 cells, whose first line has width and height."""
        with open(file, "rb") as raw:  # noqa: PTH123 - as few imports as possible
            width, height = map(int, raw.readline().split())
            cells = array.array("b", raw.read())
        message = OccupancyGrid()
        message.header.frame_id = frame
        message.info.resolution, message.info.width, message.info.height = resolution, width, height
        message.info.origin.position.x, message.info.origin.position.y = origin
        message.info.origin.orientation.w = 1.0
        message.data = cells
        self.maps.publish(message)
        self.latched.add(self.maps)

    def update(self, x: int, y: int, width: int, height: int, value: int) -> None:
        """Change a rectangle of the map."""
        from map_msgs.msg import OccupancyGridUpdate

        if not hasattr(self, "updates"):
            self.updates = self.node.create_publisher(OccupancyGridUpdate, "map_updates", 10)
        listened_to(self.updates)
        message = OccupancyGridUpdate(x=x, y=y, width=width, height=height)
        message.data = array.array("b", [value] * (width * height))
        self.updates.publish(message)

    def arrive(self) -> None:
        """Wait until the node has got what was published last on each latched topic."""
        for publisher in self.latched:
            listened_to(publisher)
            assert publisher.wait_for_all_acked(Duration(seconds=WAIT_S))

    def pose(self, x: float, y: float, yaw: float = 0.0, frame: str = "map") -> None:
        message = PoseWithCovarianceStamped()
        message.header.frame_id = frame
        fill(message.pose.pose, x, y, yaw)
        self.poses.publish(message)
        self.latched.add(self.poses)

    def scan(self, ranges: list[float], frame: str = "base_link") -> None:
        """A turn of beams, the first one straight ahead."""
        message = LaserScan()
        message.header.frame_id = frame
        message.angle_increment = 2 * math.pi / len(ranges)
        message.range_max = 10.0
        message.ranges = ranges
        listened_to(self.scans)
        self.scans.publish(message)

    def look(self, row: int, col: int, stamp: int, height: int = 240, width: int = 320) -> list[float]:
        """Publish an image with one bright spot, and wait for where the node saw it."""
        if not hasattr(self, "images"):
            self.spots: list[PointStamped] = []
            self.images = self.node.create_publisher(Image, "image", qos_profile_sensor_data)
            self.node.create_subscription(PointStamped, "spot", self.spots.append, 10)
        pixels = bytearray(height * width)
        for line in range(row - 4, row + 5):
            pixels[line * width + col - 4 : line * width + col + 5] = b"\xff" * 9
        message = Image(height=height, width=width, encoding="mono8", step=width)
        message.header.stamp.sec = stamp
        message.data = array.array("B", bytes(pixels))
        self.spots.clear()
        listened_to(self.images)
        for _ in range(TRIES):  # the first ones may be lost: each side hears of the other by itself
            self.images.publish(message)
            if waited_for(lambda: self.spots, WAIT_S / TRIES):
                spot = self.spots[-1]
                return [spot.point.y, spot.point.x, spot.header.stamp.sec]
        raise TimeoutError("no spot")

    def topic(self, goal: dict[str, Any], wait_s: float = WAIT_S) -> dict[str, Any]:
        """Ask by topic, and wait for the plan."""
        self.plans.clear()
        sent_s = time.perf_counter()
        self.goal_poses.publish(stamped(goal))
        if not waited_for(lambda: self.plans, wait_s):
            return {"poses": None}
        return self.last() | {"seconds": self.plans[-1][0] - sent_s}

    def told(self) -> dict[str, Any]:
        """The newest diagnostics of a decision."""
        waited_for(lambda: "site" in self.facts, WAIT_S)
        return self.facts

    def last(self) -> dict[str, Any]:
        """The newest plan."""
        _, path = self.plans[-1]
        return {"poses": rows(path), "frame": path.header.frame_id}


def waited_for(come: Callable[[], Any], seconds: float) -> bool:
    """Whether it came in time."""
    end_s = time.perf_counter() + seconds
    while not come() and time.perf_counter() < end_s:
        time.sleep(0.0005)
    return bool(come())


def listened_to(publisher: Any) -> None:
    assert waited_for(publisher.get_subscription_count, WAIT_S), f"nobody listens to {publisher.topic_name}"


class Actions:
    """The client of the action. The executor makes all its calls: a client of rclpy is of one thread."""

    def __init__(self, node: Any, executor: SingleThreadedExecutor, name: str) -> None:
        from nav2_msgs.action import ComputePathToPose
        from rclpy.action import ActionClient

        self.executor = executor
        self.type = ComputePathToPose
        self.client = ActionClient(
            node,
            ComputePathToPose,
            name,
            goal_service_qos_profile=ANSWERS,
            result_service_qos_profile=ANSWERS,
        )
        if not self.client.wait_for_server(timeout_sec=60.0):
            raise TimeoutError(f"no action server {name}")

    def ask(
        self, goals: list[dict[str, Any]], each_s: float = 0.0, cancel_s: float | None = None
    ) -> list[Any]:
        """Send all goals, `each_s` apart, and wait for all results. Negative: each after the one before."""
        asked = []
        for goal in goals:
            asked.append(Asked(self, goal))
            if each_s < 0:
                asked[-1].wait()
            elif each_s > 0:
                time.sleep(each_s)
        if cancel_s is not None:
            for one in asked:
                one.cancel(cancel_s)
        return [one.wait() for one in asked]


class Asked:
    """One goal on its way."""

    def __init__(self, actions: Actions, goal: dict[str, Any]) -> None:
        request = actions.type.Goal()
        request.goal = stamped(goal)
        request.planner_id = goal.get("planner", "")
        if "start" in goal:
            request.use_start = True
            request.start = stamped(goal["start"])
        self._codes = {value: name for name, value in vars_of(actions.type.Result)}
        self._done = threading.Event()
        self._accepted = threading.Event()
        self.sent_s = self.accepted_s = self.ended_s = self.canceled_s = math.nan
        self._actions = actions
        actions.executor.create_task(self._send, request)

    def _send(self, request: Any) -> None:
        self.sent_s = time.perf_counter()
        self._actions.client.send_goal_async(request).add_done_callback(self._accept)

    def _accept(self, future: Any) -> None:
        self.accepted_s = time.perf_counter()
        self.handle = future.result()
        self._accepted.set()
        self.handle.get_result_async().add_done_callback(self._end)

    def _end(self, future: Any) -> None:
        self.ended_s = time.perf_counter()
        self.answer = future.result()
        self._done.set()

    def cancel(self, after_s: float) -> None:
        assert self._accepted.wait(WAIT_S)
        time.sleep(max(0.0, self.accepted_s + after_s - time.perf_counter()))
        self._actions.executor.create_task(self._cancel)

    def _cancel(self) -> None:
        self.canceled_s = time.perf_counter()
        self.handle.cancel_goal_async()

    def wait(self) -> dict[str, Any]:
        assert self._done.wait(WAIT_S), "no result"
        result, planning = self.answer.result, self.answer.result.planning_time
        return {
            "status": {4: "succeeded", 5: "canceled", 6: "aborted"}.get(
                self.answer.status, self.answer.status
            ),
            "code": self._codes.get(result.error_code, result.error_code),
            "message": getattr(result, "error_msg", ""),
            "poses": rows(result.path),
            "frame": result.path.header.frame_id,
            "accept_s": self.accepted_s - self.sent_s,
            "seconds": self.ended_s - self.sent_s,
            "after_cancel_s": self.ended_s - self.canceled_s,
            "ended_s": self.ended_s,
            "planning_s": planning.sec + planning.nanosec * 1e-9,
        }


def vars_of(result: Any) -> list[tuple[str, int]]:
    return [(name, getattr(result, name)) for name in CODES]


def stamped(goal: dict[str, Any]) -> PoseStamped:
    message = PoseStamped()
    message.header.frame_id = goal.get("frame", "map")
    fill(message.pose, goal["x"], goal["y"], goal.get("yaw", 0.0))
    return message


def fill(pose: Any, x: float, y: float, yaw: float) -> None:
    pose.position.x, pose.position.y = float(x), float(y)
    pose.orientation.z, pose.orientation.w = math.sin(yaw / 2), math.cos(yaw / 2)


def rows(path: Path) -> list[list[float]]:
    return [
        [
            one.pose.position.x,
            one.pose.position.y,
            2 * math.atan2(one.pose.orientation.z, one.pose.orientation.w),
        ]
        for one in path.poses
    ]


def main() -> None:
    gc.disable()  # its pauses would count as time of the node
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # it ends with its commands, and says goodbye on DDS
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    peer = Peer()
    executor = SingleThreadedExecutor()
    executor.add_node(peer.node)
    spinning = threading.Thread(target=executor.spin)
    spinning.start()
    try:
        obey(peer, executor)
    finally:
        executor.shutdown()
        spinning.join()
        rclpy.shutdown()


def obey(peer: Peer, executor: SingleThreadedExecutor) -> None:
    """Do what stdin says, until it ends."""
    actions = None
    for line in sys.stdin:
        command = json.loads(line)
        name = command.pop("do")
        if name == "ask":
            actions = actions or Actions(peer.node, executor, sys.argv[1])
            answer = actions.ask(**command)
        else:
            answer = getattr(peer, name)(**command)
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
