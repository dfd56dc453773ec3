"""Settings of the simulated robot's process."""

from dataclasses import dataclass
from pathlib import Path

from offboard.common.config import check, setting
from offboard.common.errors import ConfigError
from offboard.common.planning.planner_names import DIJKSTRA, PLANNERS
from offboard.robot_client import policies, predictors
from offboard.robot_client.policies import objectives
from offboard.robot_client.policies.allowance import DUPLICATES
from offboard.robot_client.policies.energy import Energy
from offboard.robot_client.policies.objectives import OBJECTIVES
from offboard.robot_client.predictors.window import WINDOW
from offboard.robot_client.settings import Settings
from offboard.robot_client.simulated.workload import ARRIVALS, CLOSED, parse_sizes
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, TIMEOUT_S, check_endpoint

MEAN = OBJECTIVES[0]
NEEDS = {
    "deadline": "deadline_s",
    "energy": "s_per_joule",
}  # objectives, and the setting they cannot do without


@dataclass(frozen=True)
class RobotConfig:
    """What `robot-client` runs with."""

    map: Path | None = setting(None, "map to plan on: ROS map.yaml or MovingAI .map", metavar="FILE")
    task: str | None = setting(
        None,
        "instead of --map: a @task function, called with a whole number from --sizes",
        metavar="MODULE:FUNCTION",
    )
    cloud: str | None = setting(
        None, "planning server; without it all runs onboard", metavar="tcp://HOST:PORT"
    )
    site: tuple[str, ...] = setting((), "a further named server; may be given again", metavar="NAME=ENDPOINT")
    keys: Path | None = setting(
        None,
        "folder with robot.key_secret, as `robot-client keys` makes it, and the server's public server.key, "
        "or NAME.key for the server of --site NAME: all is encrypted (CURVE)",
        metavar="DIR",
    )
    policy: str = setting(policies.DEFAULT, f"where to run: {policies.HELP}", metavar="NAME")
    predictor: str | None = setting(
        None, f"how times are predicted, instead of the policy's own way: {predictors.HELP}", metavar="NAME"
    )
    window: int = setting(WINDOW, "executions remembered for each site", minimum=2, maximum=1_000_000)
    objective: str = setting(
        MEAN, "what the policy makes small; p95: the time 95 % stay below", choices=OBJECTIVES
    )
    deadline_s: float | None = setting(
        None, "seconds, for --objective deadline", name="deadline", minimum=0.001, maximum=3600
    )
    s_per_joule: float | None = setting(
        None, "seconds that a joule is worth, for --objective energy", minimum=0.0, maximum=1e6
    )
    compute_watts: float = setting(
        Energy().compute_w, "that one busy core takes above idle", minimum=0.0, maximum=1e4
    )
    idle_watts: float = setting(
        Energy().idle_w, "while waiting for an answer, where waiting is not free", minimum=0.0, maximum=1e4
    )
    radio_joules_byte: float = setting(
        Energy().radio_j_byte, "that a byte takes, sent or received", minimum=0.0, maximum=1.0
    )
    bytes_per_minute: float | None = setting(
        None, "cap on what is sent and received; puts budget around the policy", minimum=0.0, maximum=1e15
    )
    joules_per_minute: float | None = setting(
        None,
        "cap on what tasks take from the battery; puts budget around the policy",
        minimum=0.0,
        maximum=1e9,
    )
    duplicates: float = setting(
        DUPLICATES, "second runs a task, of probes and hedges", minimum=0.0, maximum=1.0, metavar="SHARE"
    )
    memory: Path | None = setting(None, "keep what is learnt in this file, and start with what is in it")
    tasks: int = setting(200, "plans to make, or calls", minimum=1, maximum=1_000_000)
    sizes: tuple[str, ...] = setting(
        (),
        "input sizes: constant:X, uniform:LOW:HIGH, lognormal:MEDIAN:SIGMA or a CSV file with a size column; "
        "K= before it: from task K on; may be given again; on a map goals are picked for them",
        metavar="SPEC",
    )
    arrivals: str = setting(
        CLOSED,
        "when tasks are due: closed when the last is answered, the others at --rate whatever the answers",
        choices=ARRIVALS,
    )
    rate: float | None = setting(None, "tasks per second, unless closed", minimum=0.001, maximum=100_000)
    burst: int = setting(10, "with bursts: K tasks at once", minimum=1, maximum=1_000_000)
    in_flight: int = setting(
        16, "unless closed: tasks at a time; those beyond begin late", minimum=1, maximum=1024
    )
    jump: bool = setting(
        False, "stand at each goal next, whatever was answered: each run of a seed asks for the same plans"
    )
    answers: Path | None = setting(
        None, "append one JSON line a task with its answer; tasks that have one are not asked again"
    )
    measure: int = setting(0, "run the first K of them on both sites", minimum=0)
    alone: int = setting(
        0,
        "then run K further plans onboard alone, in the cloud alone and on both at once; "
        "their trace is beside --trace",
        minimum=0,
    )
    reference: int = setting(
        0,
        "run every K-th task again on each site alone, in a file beside --trace; 0: none",
        minimum=0,
        maximum=1_000_000,
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
    planner: str = setting(DIJKSTRA, "how paths are searched; all find the same cost", choices=PLANNERS)
    obstacles: int = setting(40, "boxes in the world that the map lacks", minimum=0, maximum=10_000)
    radius_m: float = setting(0.15, "radius of the robot in metres", name="radius", minimum=0.0, maximum=10.0)
    connect_s: float = setting(
        10.0, "seconds to wait for the servers at start", name="connect", minimum=0.0, maximum=3600
    )
    metrics: str | None = setting(None, "serve Prometheus metrics", metavar="HOST:PORT")
    log: str = setting("warning", "log level", choices=("debug", "info", "warning", "error"))

    def __post_init__(self) -> None:
        check(self)
        policies.check_name(self.policy, "--policy")
        if self.predictor is not None:
            predictors.check_name(self.predictor, "--predictor")
        if self.measure > self.tasks:
            raise ConfigError(f"--measure: {self.measure} is above --tasks {self.tasks}")
        self._check_work()
        self._check_objective()
        self._check_arrivals()
        self._check_repeats()
        if self.cloud is not None:
            check_endpoint("--cloud", self.cloud)
        self.sites()

    def _check_work(self) -> None:
        if self.map is None and self.task is None:
            raise ConfigError("--map is missing: a map to plan on, or --task MODULE:FUNCTION instead")
        if self.map is not None and self.task is not None:
            raise ConfigError(f"--task: {self.task!r} is not allowed beside --map {self.map}")
        if self.task is not None and not self.sizes:
            raise ConfigError(f"--task: {self.task!r} needs --sizes")
        parse_sizes(self.sizes)
        if self.answers is not None and self.answers == self.trace:
            raise ConfigError(f"--answers: {self.answers} is the file of --trace")

        if self.memory is not None and self.memory in (self.trace, self.answers):
            raise ConfigError(f"--memory: {self.memory} is the file of --trace or --answers")

    def _check_objective(self) -> None:
        for name, setting_of in NEEDS.items():
            value, flag = getattr(self, setting_of), setting_of.removesuffix("_s").replace("_", "-")
            if self.objective == name and value is None:
                raise ConfigError(f"--objective: {name} needs --{flag}")
            if self.objective != name and value is not None:
                raise ConfigError(f"--{flag}: {value:g} needs --objective {name}")
        if self.objective != MEAN and not policies.weighs_cost(self.policy):
            raise ConfigError(f"--objective: {self.objective} changes nothing with --policy {self.policy}")

    def _check_arrivals(self) -> None:
        if self.arrivals == CLOSED:
            return
        if self.rate is None:
            raise ConfigError(f"--arrivals: {self.arrivals} needs --rate, tasks per second")
        if self.map is not None and not self.jump:
            raise ConfigError(f"--arrivals: {self.arrivals} on a map needs --jump")
        for flag in ("measure", "alone", "reference"):
            if getattr(self, flag):
                raise ConfigError(f"--{flag}: {getattr(self, flag)} needs --arrivals {CLOSED}")

    def _check_repeats(self) -> None:
        """What runs tasks again, after the run or in it."""
        if self.alone > self.tasks:
            raise ConfigError(f"--alone: {self.alone} is above --tasks {self.tasks}")
        for flag, value in (("--trace", self.trace), ("--cloud", self.cloud)):
            if self.alone and value is None:
                raise ConfigError(f"--alone: {self.alone} plans cannot be measured without {flag}")
            if self.reference and value is None:
                raise ConfigError(f"--reference: {self.reference} needs {flag}")
        if self.reference and self.map is not None and not self.jump:
            raise ConfigError(f"--reference: {self.reference} on a map needs --jump")

    def settings(self) -> Settings:
        """The rare options of the offloader."""
        return Settings(
            predictor=self.predictor,
            objective=objectives.make(self.objective, deadline_s=self.deadline_s, s_a_joule=self.s_per_joule),
            energy=Energy(self.compute_watts, self.idle_watts, self.radio_joules_byte),
            duplicates=self.duplicates,
            bytes_a_minute=self.bytes_per_minute,
            joules_a_minute=self.joules_per_minute,
            memory=self.memory,
            seed=self.seed,
        )

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
