"""A peer without ROS, in a process of its own: publishes a map and a pose, and asks for paths by topic.

It has the commands of `peer.py` that need no action. Its messages are those of the bridge, whose types the
tests with rclpy peers check.
"""

import json
import os
import signal
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from offboard.common.planning.maps import GridMap
from offboard.common.planning.planner import Pose
from offboard.ros2 import converters as ros
from offboard.ros2.bridge import DDS, EACH, LATCHED, SETTINGS, TYPES

WAIT_S = 30.0
MAP = ros.Header("map")


class DdsPeer:
    """Publishes what a robot publishes, and asks for paths."""

    def __init__(self, domain: int) -> None:
        self.domain = Domain(domain, SETTINGS)
        self.participant = DomainParticipant(domain)
        self.maps = DataWriter(self.participant, self.on("nav_msgs/msg/OccupancyGrid", "map"), LATCHED)
        pose = "geometry_msgs/msg/PoseWithCovarianceStamped"
        self.poses = DataWriter(self.participant, self.on(pose, "amcl_pose"), LATCHED)
        goal = self.on("geometry_msgs/msg/PoseStamped", "goal_pose")
        self.goals = DataWriter(self.participant, goal, EACH)
        self.plans = DataReader(self.participant, self.on("nav_msgs/msg/Path", "plan"), EACH)
        status = self.on("diagnostic_msgs/msg/DiagnosticArray", "diagnostics")
        self.diagnostics = DataReader(self.participant, status, EACH)
        self.latched: set[Any] = set()

    def on(self, kind: str, name: str) -> Any:
        return Topic(self.participant, f"rt/{name}", TYPES[kind])

    def map(self, file: str, resolution: float, origin: list[float]) -> None:
        size, _, cells = Path(file).read_bytes().partition(b"\n")
        width, height = map(int, size.split())
        grid = GridMap(np.frombuffer(cells, np.int8).reshape(height, width), resolution, (*origin, 0.0))
        self.maps.write(ros.grid_message(DDS, grid, MAP))
        self.latched.add(self.maps)

    def pose(self, x: float, y: float) -> None:
        make, pose = DDS.make, ros.pose_message(DDS, Pose(x, y))
        inner = make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=[0.0] * 36)
        header = MAP.message(DDS)
        self.poses.write(make("geometry_msgs/msg/PoseWithCovarianceStamped", header=header, pose=inner))
        self.latched.add(self.poses)

    def arrive(self) -> None:
        """Wait until the other side has got what was published last on each latched topic."""
        end_s = time.perf_counter() + WAIT_S
        while not all(writer.get_matched_subscriptions() for writer in self.latched):
            assert time.perf_counter() < end_s, "nobody listens"
            time.sleep(0.01)
        for writer in self.latched:
            assert writer.wait_for_acks(duration(seconds=WAIT_S))

    def topic(self, goal: dict[str, float], wait_s: float = WAIT_S) -> dict[str, Any]:
        self.plans.take(N=1000)
        sent_s = time.perf_counter()
        pose = Pose(goal["x"], goal["y"], goal["yaw"])
        self.goals.write(ros.stamped_pose(DDS, pose, MAP))
        while time.perf_counter() - sent_s < wait_s:
            if plans := self.plans.take():
                seconds, path = time.perf_counter() - sent_s, plans[-1]
                poses = ros.path_poses(path).tolist()
                return {"poses": poses, "seconds": seconds, "frame": path.header.frame_id}
            time.sleep(0.0005)
        return {"poses": None}

    def last(self) -> dict[str, Any]:
        """The newest plan."""
        path = self.plans.take(N=1000)[-1]
        return {"poses": ros.path_poses(path).tolist(), "frame": path.header.frame_id}

    def told(self) -> dict[str, str]:
        """The newest diagnostics of a decision."""
        last = self.diagnostics.take(N=1000)[-1]
        return {one.key: one.value for one in last.status[0].values}


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # it ends with its commands, and says goodbye on DDS
    peer = DdsPeer(int(os.environ["ROS_DOMAIN_ID"]))
    for line in sys.stdin:
        command = json.loads(line)
        print(json.dumps(getattr(peer, command.pop("do"))(**command)), flush=True)
