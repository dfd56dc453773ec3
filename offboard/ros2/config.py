"""The settings of `robot-client ros2`: which servers the robot may use, and how it decides.

What nav2 sets by parameters (tolerance, frames, topics) are parameters of the node, in `node`.
"""

from dataclasses import dataclass
from pathlib import Path

from offboard.common.config import check, setting
from offboard.common.errors import ConfigError
from offboard.robot_client import policies
from offboard.robot_client.predictors.window import WINDOW
from offboard.robot_client.settings import Settings
from offboard.robot_client.sites.runner import TIMEOUT_S, check_endpoint


@dataclass(frozen=True)
class Ros2Config:
    """Everything that the offloader of the node needs."""

    cloud: str | None = setting(
        None, "server to use; without it, all goals are planned onboard", metavar="tcp://HOST:PORT"
    )
    sites: Path | None = setting(
        None, "TOML file of further servers, which is read again every 2 s", metavar="FILE"
    )
    bridge: bool = setting(
        False, "speak DDS without ROS, by cyclonedds: topics only, and no action (extra dds)"
    )
    keys: Path | None = setting(
        None,
        "folder with robot.key_secret and server.key, as for `Offloader.connect(keys=...)`; without it, "
        "nothing is encrypted",
        metavar="DIR",
    )
    timeout_s: float = setting(
        TIMEOUT_S,
        "time to wait for an answer of the server before the goal is planned onboard, in seconds",
        name="timeout",
        minimum=0.001,
        maximum=3600,
    )
    connect_s: float = setting(
        10.0, "time to wait for the server at start, in seconds", name="connect", minimum=0.0, maximum=3600
    )
    policy: str = setting(policies.DEFAULT, f"rule that chooses the site: {policies.HELP}", metavar="NAME")
    window: int = setting(WINDOW, "executions remembered for each site", minimum=2, maximum=1_000_000)
    memory: Path | None = setting(None, "file that keeps what the robot learns, and is read at start")
    trace: Path | None = setting(None, "file that gets a line for every goal")
    metrics: str | None = setting(None, "address where Prometheus reads /metrics", metavar="HOST:PORT")

    def __post_init__(self) -> None:
        check(self)
        policies.check_name(self.policy, "--policy")
        if self.cloud is not None:
            check_endpoint("--cloud", self.cloud)
        if self.memory is not None and self.memory == self.trace:
            raise ConfigError(f"--memory: {self.memory} is also the file of --trace")

    def settings(self) -> Settings:
        return Settings(window=self.window, memory=self.memory)
