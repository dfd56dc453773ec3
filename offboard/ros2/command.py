"""The command `robot-client ros2`: reads the settings, and runs the planner server as a node of ROS 2.

What the node does is in `node`.
"""

import logging
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from offboard.common.command_line import load
from offboard.common.config import as_dict, check, setting
from offboard.common.errors import ConfigError
from offboard.robot_client.flags import DecisionFlags, ServerFlags

if TYPE_CHECKING:
    from offboard.robot_client.offloader import Offloader
    from offboard.ros2.topics import Diagnostics

ROS_ARGS = "--ros-args"
ABOUT = (
    "Plan paths for nav2 onboard or in the cloud: a node with the action of nav2's planner_server. "
    f"What follows {ROS_ARGS} is for ROS, for example: {ROS_ARGS} -p robot_radius:=0.2."
)

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Ros2Config(DecisionFlags, ServerFlags):
    """Which servers the robot may use, how it decides, and what it records.

    What nav2 sets by parameters (tolerance, frames, topics) are parameters of the node.
    """

    bridge: bool = setting(
        False, "speak DDS without ROS, by cyclonedds: topics only, and no action (extra dds)"
    )
    trace: Path | None = setting(None, "file that gets a line for every goal")
    metrics: str | None = setting(None, "address where Prometheus reads /metrics", metavar="HOST:PORT")

    def __post_init__(self) -> None:
        check(self)
        self.check_servers()
        self.check_decisions()
        if self.memory is not None and self.memory == self.trace:
            raise ConfigError(f"--memory: {self.memory} is also the file of --trace")


def run_ros2(argv: Sequence[str]) -> int:
    """Run the node, or the bridge, until it is interrupted."""
    own = list(argv[: argv.index(ROS_ARGS)] if ROS_ARGS in argv else argv)
    for_ros = list(argv[len(own) :])
    config = load(
        Ros2Config, own, prog="robot-client ros2", description=ABOUT, environ=os.environ, prefix="ROBOT_ROS2"
    )
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    serve = _bridge(for_ros) if config.bridge else _node(for_ros)
    log.info("settings: %s", as_dict(config))
    from offboard.robot_client.offloader import Offloader
    from offboard.ros2.planner_server import prepare
    from offboard.ros2.topics import Diagnostics

    facts = Diagnostics()
    with Offloader.connect(
        config.cloud,
        sites=config.sites or config.further(),
        policy=config.policy,
        timeout_s=config.timeout_s,
        keys=config.keys,
        observers=[facts],
        metrics=config.metrics,
        trace=config.trace,
        settings=config.settings(),
    ) as offload:
        for line in prepare(offload, config.connect_s):
            log.warning("starting without %s: goals are planned elsewhere; remedy: robot-client check", line)
        serve(offload, facts)
    return 0


Serve = Callable[["Offloader", "Diagnostics"], None]


def _node(arguments: Sequence[str]) -> Serve:
    from offboard.ros2.node import serve  # needs rclpy

    return lambda offload, facts: serve(offload, facts, arguments)


def _bridge(arguments: Sequence[str]) -> Serve:
    from offboard.ros2.bridge import serve  # needs cyclonedds
    from offboard.ros2.parameters import read_arguments

    parameters = read_arguments(arguments)
    return lambda offload, facts: serve(offload, facts, parameters)
