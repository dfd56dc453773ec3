"""The planner server as a node of ROS 2; the only file that imports rclpy.

It replaces nav2's `planner_server`: same action, same topics, same parameters. What the messages mean is
`topics`.
"""

import contextlib
import logging
from collections.abc import Iterator, Sequence
from types import SimpleNamespace
from typing import Any

from offboard.common.errors import ConfigError
from offboard.common.planning.planner import Pose
from offboard.robot_client.offloader import Offloader
from offboard.ros2.converters import pose_of
from offboard.ros2.parameters import Parameters
from offboard.ros2.planner_server import CANCELED, SUCCEEDED, UNKNOWN, Outcome, PendingGoal
from offboard.ros2.ros_messages import ROS, find
from offboard.ros2.topics import NAME, SAME, Diagnostics, SameFrames, Topics
from offboard.ros2.topics import Transforms as Frames

try:
    import rclpy
    from rclpy.action import ActionServer, CancelResponse
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
    from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
    from rclpy.task import Future
    from rclpy.time import Time
except ImportError as error:
    raise ConfigError(
        f"rclpy cannot be imported ({error}): source the setup.bash of a ROS 2 release, or install "
        "'ros-kilted-rclpy[fastrtps]' ros-kilted-nav-msgs (docs/ros2.md)"
    ) from error

# A node without a timer may miss SIGTERM: rclpy wakes it before it ends the context.
DIAGNOSTICS_EVERY_S = 1.0
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
RESULTS_KEPT_S = 10  # for a client that asks late; Jazzy would keep the paths of 15 minutes
REQUESTS = QoSProfile(depth=100)  # of goals at once; services keep 10 by default, and lose the others

log = logging.getLogger(__name__)


class PlannerNode:
    """Connects action and topics of ROS to `Topics`. All its callbacks run in the thread of the executor."""

    def __init__(self, node: Any, executor: Any, topics: Topics, parameters: Parameters) -> None:
        self.node = node
        self._executor = executor
        self._topics = topics
        self._pending: dict[bytes, PendingGoal] = {}
        self._plans = node.create_publisher(find("nav_msgs/msg/Path"), "plan", 1)
        self._diagnostics = node.create_publisher(
            find("diagnostic_msgs/msg/DiagnosticArray"), "/diagnostics", 10
        )
        self._subscribe(parameters)
        self._serve(parameters.action)
        node.create_timer(DIAGNOSTICS_EVERY_S, self._tell)

    def _subscribe(self, parameters: Parameters) -> None:
        topics, create = self._topics, self.node.create_subscription
        create(find("nav_msgs/msg/OccupancyGrid"), parameters.map_topic, topics.see_map, LATCHED)
        pose = find("geometry_msgs/msg/PoseWithCovarianceStamped")
        create(pose, "amcl_pose", topics.see_pose, LATCHED)
        create(find("nav_msgs/msg/Odometry"), "odom", topics.see_pose, qos_profile_sensor_data)
        if parameters.scan_topic and not parameters.costmap:
            scan = find("sensor_msgs/msg/LaserScan")
            create(scan, parameters.scan_topic, topics.see_scan, qos_profile_sensor_data)
        updates = "map_msgs/msg/OccupancyGridUpdate"
        if _installed(updates):
            create(find(updates), f"{parameters.map_topic}_updates", topics.update_map, 10)
        else:
            log.info("map_msgs is not installed: %s_updates is ignored", parameters.map_topic)

    def _serve(self, name: str) -> None:
        """The action, or without nav2_msgs the topic `goal_pose`."""
        if _installed("nav2_msgs/action/ComputePathToPose"):
            self._action: Any = find("nav2_msgs/action/ComputePathToPose")
            self._server = ActionServer(
                self.node,
                self._action,
                name,
                self._execute,
                cancel_callback=self._cancel,
                goal_service_qos_profile=REQUESTS,
                result_service_qos_profile=REQUESTS,
                cancel_service_qos_profile=REQUESTS,
                result_timeout=RESULTS_KEPT_S,
            )
            log.info("ready: action %s", name)
        else:
            self.node.create_subscription(
                find("geometry_msgs/msg/PoseStamped"), "goal_pose", self._take_goal, 10
            )
            log.info("ready: topics goal_pose and plan, because nav2_msgs is not installed")

    async def _execute(self, handle: Any) -> Any:
        """One goal of the action. It waits here while the planner server plans in its thread."""
        answered = Future()

        def done(outcome: Outcome) -> None:
            answered.set_result((outcome, self._path(outcome)))  # a long path takes a while to make
            self._executor.wake()  # or it would look at the waiting goals only after the next message

        name, request = bytes(handle.goal_id.uuid), handle.request
        start = request.start if request.use_start else None
        self._pending[name] = self._topics.accept(request.goal, start, request.planner_id, done)
        outcome, path = await answered
        del self._pending[name]
        self._publish(outcome, path)
        {SUCCEEDED: handle.succeed, CANCELED: handle.canceled}.get(outcome.ending, handle.abort)()
        return self._result(outcome, path)

    def _cancel(self, handle: Any) -> Any:
        pending = self._pending.get(bytes(handle.goal_id.uuid))
        if pending is not None:
            self._topics.cancel(pending)
        return CancelResponse.ACCEPT

    def _take_goal(self, message: Any) -> None:
        """One goal of the topic."""

        def done(outcome: Outcome) -> None:
            self._executor.create_task(self._publish, outcome, self._path(outcome))

        self._topics.accept(message, None, "", done)

    def _path(self, outcome: Outcome) -> Any:
        return self._topics.path(outcome, self._now_ns())

    def _publish(self, outcome: Outcome, path: Any) -> None:
        if outcome.ending == SUCCEEDED:
            self._plans.publish(path)
        self._tell()

    def _tell(self) -> None:
        self._diagnostics.publish(self._topics.diagnostics(self._now_ns()))

    def _now_ns(self) -> int:
        return int(self.node.get_clock().now().nanoseconds)

    def _result(self, outcome: Outcome, path: Any) -> Any:
        result = self._action.Result()
        result.path = path
        nanoseconds = int(outcome.seconds * 1e9)
        result.planning_time.sec, result.planning_time.nanosec = divmod(nanoseconds, 1_000_000_000)
        if hasattr(result, "error_code"):  # not in Humble
            result.error_code = self._code(outcome.status)
        if hasattr(result, "error_msg"):
            result.error_msg = outcome.message
        return result

    def _code(self, status: str) -> int:
        """The number of a status, which differs between releases of nav2; Iron has them in the goal."""
        for part in (self._action.Result, self._action.Goal):
            if hasattr(part, UNKNOWN):
                return int(getattr(part, status, getattr(part, UNKNOWN)))
        return 0


class TransformBuffer:
    """Frames as tf2 knows them."""

    def __init__(self, node: Any) -> None:
        import tf2_ros

        self._buffer = tf2_ros.Buffer()
        self._listener = tf2_ros.TransformListener(self._buffer, node)

    def of(self, frame: str, seen_from: str) -> Pose | None:
        if frame == seen_from:
            return SAME
        if not self._buffer.can_transform(seen_from, frame, Time()):
            return None
        found = self._buffer.lookup_transform(seen_from, frame, Time()).transform
        return pose_of(SimpleNamespace(position=found.translation, orientation=found.rotation))


@contextlib.contextmanager
def until_shutdown() -> Iterator[None]:
    """The end of ROS, by a signal or a shutdown, ends this block without an error.

    rclpy shuts its context down in another thread. If that thread is between two steps of `spin`, rclpy
    raises an RCLError (a RuntimeError) instead of ExternalShutdownException (ros2cli#854).
    """
    try:
        with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
            yield
    except RuntimeError:
        if rclpy.ok():
            raise


def serve(offload: Offloader, facts: Diagnostics, arguments: Sequence[str]) -> None:
    """Run the node until it is interrupted. `arguments` are those for ROS."""
    rclpy.init(args=list(arguments))
    node = rclpy.create_node(NAME)
    executor = SingleThreadedExecutor()
    try:
        parameters = Parameters.read(lambda name, default: node.declare_parameter(name, default).value)
        topics = Topics(ROS, offload, parameters=parameters, facts=facts, transforms=_transforms(node))
        try:
            served = PlannerNode(node, executor, topics, parameters)
            executor.add_node(served.node)
            with until_shutdown():
                executor.spin()
        finally:
            topics.close()
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


def _transforms(node: Any) -> Frames:
    try:
        return TransformBuffer(node)
    except ImportError:
        log.info("tf2 is not installed: the pose comes from amcl_pose or odom, in the frame of the map")
        return SameFrames()


def _installed(name: str) -> bool:
    try:
        find(name)
    except ConfigError:
        return False
    return True
