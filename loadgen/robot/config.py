"""The settings of `loadgen drive` and `loadgen call`: those that both have, and those of each."""

from dataclasses import dataclass
from pathlib import Path

from offboard.common.config import REQUIRED, check, setting
from offboard.common.errors import ConfigError
from offboard.common.planning.planner_names import DIJKSTRA, PLANNERS
from offboard.common.security.address import address
from offboard.common.variants import IN_GROUP
from offboard.loadgen.robot.decision_settings import DecisionSettings
from offboard.loadgen.robot.run_settings import RunSettings
from offboard.loadgen.robot.workload import CLOSED, SIZES_ALLOWED, parse_sizes
from offboard.robot_client.discovery.dns_name import check_dns, is_dns
from offboard.robot_client.openpi.endpoint import check_site
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, TIMEOUT_S

SERVERS, PLANS, CALLS = "servers", "map and robot", "task"


@dataclass(frozen=True)
class ServerSettings:
    """Which servers the robot may use, and how long it waits for them."""

    cloud: str | None = setting(
        None,
        "server to use; without any server, all tasks run onboard",
        group=SERVERS,
        metavar="tcp://HOST:PORT",
    )
    site: tuple[str, ...] = setting(
        (),
        "a further server, with a name, or GROUP/NAME for one of several equal servers; ws:// or wss:// is a "
        "policy server; dns://HOST:PORT is a server at each address of HOST, of which 4 are used at a time; "
        "repeat the flag for more",
        group=SERVERS,
        rare=True,
        metavar="NAME=ENDPOINT",
    )
    sites: Path | None = setting(
        None,
        "TOML file of servers with endpoint, key and group (docs/formats.md), read again every 2 s",
        group=SERVERS,
        rare=True,
        metavar="FILE",
    )
    keys: Path | None = setting(
        None,
        "folder with robot.key_secret (made by `robot-client keys`) and server.key (copied from the server; "
        "NAME.key for the server of --site NAME); without it, nothing is encrypted",
        group=SERVERS,
        metavar="DIR",
    )
    insecure: bool = setting(
        False,
        "allow ws:// to a policy server beyond this computer, and dns:// and --sites without --keys: anyone "
        "on the way can read and change what is sent",
        group=SERVERS,
        rare=True,
    )
    timeout_s: float = setting(
        TIMEOUT_S,
        "time to wait for an answer of a server before the task runs onboard, in seconds",
        group=SERVERS,
        name="timeout",
        minimum=0.001,
        maximum=3600,
    )
    connect_s: float = setting(
        10.0,
        "time to wait for the servers at start, in seconds",
        group=SERVERS,
        rare=True,
        name="connect",
        minimum=0.0,
        maximum=3600,
    )

    def check_servers(self) -> None:
        if self.cloud is not None:
            check_site("--cloud", self.cloud, insecure=self.insecure)
        if self.sites is not None and self.site:
            raise ConfigError(f"--sites: {self.sites} cannot be combined with --site; list all servers in it")
        if self.keys is not None and self.cloud is None and not (self.site or self.sites):
            raise ConfigError(f"--keys: {self.keys} needs --cloud, the server to use")
        self.further()

    @property
    def changing(self) -> str | None:
        """The flag of servers that may change during the run."""
        if self.sites is not None:
            return "--sites"
        return next((f"--site {name}" for name, one in self.further().items() if is_dns(one)), None)

    def further(self) -> dict[str, str]:
        """The endpoint of each --site, by its name."""
        found: dict[str, str] = {}
        for entry in self.site:
            name, equals, endpoint = entry.partition("=")
            parts = name.split(IN_GROUP)
            if not (equals and len(parts) <= 2 and all(part.isidentifier() for part in parts)):
                allowed = "NAME=tcp://HOST:PORT or NAME=ws://HOST:PORT, where NAME may be GROUP/NAME"
                raise ConfigError(f"--site: {entry!r} is not {allowed}")
            free = CLOUD if self.cloud is None and is_dns(endpoint) else ""
            if name in {ONBOARD, CLOUD, *found} - {free}:
                raise ConfigError(f"--site: {entry!r}: the name {name!r} is already taken")
            if is_dns(endpoint):
                check_dns(f"--site {name}", endpoint)
            else:
                check_site(f"--site {name}", endpoint, insecure=self.insecure)
            found[name] = endpoint
        return found


# The help shows the fields of the last base class first.
@dataclass(frozen=True)
class RobotConfig(RunSettings, DecisionSettings, ServerSettings):
    """What `drive` and `call` have in common."""

    def __post_init__(self) -> None:
        check(self)
        self.check_servers()
        self.check_decisions()
        self.check_run(cloud=self.cloud)
        if self.reference and self.changing:
            raise ConfigError(f"--reference: {self.reference} needs servers that stay, so no {self.changing}")
        if self.metrics is not None:
            address("--metrics", self.metrics)
        if self.memory is not None and self.memory in (self.trace, self.answers):
            raise ConfigError(f"--memory: {self.memory} is also the file of --trace or --answers")


@dataclass(frozen=True, kw_only=True)
class MapSettings:
    """The map, the robot on it, and the plans that it asks for."""

    map: Path = setting(REQUIRED, "map to drive on: ROS map.yaml or MovingAI .map", group=PLANS)
    resolution: float | None = setting(
        None,
        "cell size to plan at, in metres (default: that of the map; another one must divide it evenly; "
        "a MovingAI map keeps its 1 m)",
        group=PLANS,
        minimum=0.001,
    )
    planner: str = setting(
        DIJKSTRA,
        "search algorithm; all of them find paths of the same cost",
        group=PLANS,
        rare=True,
        choices=PLANNERS,
    )
    radius_m: float = setting(
        0.15,
        "radius of the robot, in metres",
        group=PLANS,
        rare=True,
        name="radius",
        minimum=0.0,
        maximum=10.0,
    )
    obstacles: int = setting(
        40,
        "boxes that stand in the world but not on the map",
        group=PLANS,
        rare=True,
        minimum=0,
        maximum=10_000,
    )
    jump: bool = setting(
        False,
        "put the robot at each goal instead of driving there, so that answers do not change later tasks",
        group=PLANS,
        rare=True,
    )
    picture: Path | None = setting(
        None,
        "draw the last plan with a path into this PNG file: map, robot, scan and path",
        group=PLANS,
        rare=True,
        metavar="FILE.png",
    )
    sizes: tuple[str, ...] = setting(
        (),
        f"input sizes; the robot picks goals that match them: {SIZES_ALLOWED}; repeat the flag for phases",
        group=PLANS,
        rare=True,
        metavar="SPEC",
    )


@dataclass(frozen=True, kw_only=True)
class DriveConfig(RobotConfig, MapSettings):
    """The settings of `loadgen drive`: a simulated robot asks for plans on a map."""

    def __post_init__(self) -> None:
        super().__post_init__()
        parse_sizes(self.sizes)
        if self.picture is not None and self.picture.suffix.lower() != ".png":
            raise ConfigError(f"--picture: {self.picture} must end with .png")
        if self.jump:
            return
        if self.arrivals != CLOSED:
            raise ConfigError(f"--arrivals: {self.arrivals} on a map needs --jump")
        if self.reference:
            raise ConfigError(f"--reference: {self.reference} on a map needs --jump")


@dataclass(frozen=True, kw_only=True)
class TaskSettings:
    """The task that is called."""

    task: str = setting(
        REQUIRED,
        "the @task function to call, with one whole number of --sizes or with the arguments of --inputs",
        group=CALLS,
        metavar="MODULE:FUNCTION",
    )
    sizes: tuple[str, ...] = setting(
        (),
        f"input sizes: {SIZES_ALLOWED}; repeat the flag for phases",
        group=CALLS,
        metavar="SPEC",
    )

    inputs: str | None = setting(
        None,
        "function that takes the seed and returns an iterable of calls; each is a tuple of arguments, "
        "or the only argument",
        group=CALLS,
        metavar="MODULE:FUNCTION",
    )


@dataclass(frozen=True, kw_only=True)
class CallConfig(RobotConfig, TaskSettings):
    """The settings of `loadgen call`: any task, called with numbers or with inputs."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.sizes and self.inputs is None:
            raise ConfigError(f"--task: {self.task!r} needs --sizes or --inputs")
        if self.sizes and self.inputs is not None:
            raise ConfigError(f"--inputs: {self.inputs!r} cannot be combined with --sizes")
        parse_sizes(self.sizes)
