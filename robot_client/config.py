"""Settings of the simulated robot's process."""

from dataclasses import dataclass
from pathlib import Path

from common.config import REQUIRED, check, setting
from common.errors import ConfigError
from robot_client import policies, predictors
from robot_client.offloader import TIMEOUT_S, WINDOW
from robot_client.runner import CLOUD, ONBOARD, check_endpoint


@dataclass(frozen=True)
class RobotConfig:
    """What `robot-client` runs with."""

    map: Path = setting(REQUIRED, "map to plan on: ROS map.yaml or MovingAI .map", metavar="FILE")
    cloud: str | None = setting(
        None, "planning server; without it all runs onboard", metavar="tcp://HOST:PORT"
    )
    site: tuple[str, ...] = setting((), "a further named server; may be given again", metavar="NAME=ENDPOINT")
    policy: str = setting("paper", "where to run", choices=policies.names())
    predictor: str = setting(
        predictors.LEAST_SQUARES, f"how times are predicted: {predictors.HELP}", metavar="NAME"
    )
    window: int = setting(WINDOW, "executions remembered for each site", minimum=2, maximum=1_000_000)
    tasks: int = setting(200, "plans to make", minimum=1, maximum=1_000_000)
    measure: int = setting(0, "run the first K of them on both sites", minimum=0)
    alone: int = setting(
        0,
        "then run K further plans onboard alone, in the cloud alone and on both at once; "
        "their trace is beside --trace",
        minimum=0,
    )
    timeout_s: float = setting(
        TIMEOUT_S,
        "seconds to wait for a server before running onboard",
        name="timeout",
        minimum=0.001,
        maximum=3600,
    )
    trace: Path | None = setting(None, "append one JSON line a task")
    seed: int = setting(1, "of start, goals and obstacles", minimum=0)
    resolution: float = setting(0.025, "metres a cell to plan at; MovingAI maps keep 1 m", minimum=0.001)
    obstacles: int = setting(40, "boxes in the world that the map lacks", minimum=0, maximum=10_000)
    radius_m: float = setting(0.15, "radius of the robot in metres", name="radius", minimum=0.0, maximum=10.0)
    connect_s: float = setting(
        10.0, "seconds to wait for the servers at start", name="connect", minimum=0.0, maximum=3600
    )
    metrics: str | None = setting(None, "serve Prometheus metrics", metavar="HOST:PORT")
    log: str = setting("warning", "log level", choices=("debug", "info", "warning", "error"))

    def __post_init__(self) -> None:
        check(self)
        predictors.check_name(self.predictor, "--predictor")
        if self.measure > self.tasks:
            raise ConfigError(f"--measure: {self.measure} is above --tasks {self.tasks}")
        self._check_alone()
        if self.cloud is not None:
            check_endpoint("--cloud", self.cloud)
        self.sites()

    def _check_alone(self) -> None:
        if self.alone > self.tasks:
            raise ConfigError(f"--alone: {self.alone} is above --tasks {self.tasks}")
        for flag, value in (("--trace", self.trace), ("--cloud", self.cloud)):
            if self.alone and value is None:
                raise ConfigError(f"--alone: {self.alone} plans cannot be measured without {flag}")

    def sites(self) -> dict[str, str]:
        """Endpoint by name of every `--site`."""
        found: dict[str, str] = {}
        for entry in self.site:
            name, equals, endpoint = entry.partition("=")
            if not (equals and name.isidentifier()) or name in (ONBOARD, CLOUD, *found):
                raise ConfigError(f"--site: {entry!r} is not NAME=tcp://HOST:PORT with a name of its own")
            check_endpoint(f"--site {name}", endpoint)
            found[name] = endpoint
        return found
