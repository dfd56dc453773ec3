"""The settings of `loadgen drive` and `loadgen call`: those that both have, and those of each.

A scenario takes some of them for its `[workload]`.
"""

from dataclasses import dataclass
from pathlib import Path

from offboard.common.config import REQUIRED, check, setting
from offboard.common.errors import ConfigError
from offboard.common.logs import JSON, LEVELS, TEXT
from offboard.common.planning import DIJKSTRA, PLANNERS
from offboard.common.security.address import address
from offboard.loadgen.rivals.stream_rules import RULES, STREAM
from offboard.loadgen.robot.workload import ARRIVALS, CLOSED, SIZES_ALLOWED, parse_sizes
from offboard.robot_client.flags import DecisionFlags, ServerFlags
from offboard.robot_client.streams.asking import BLEND, CALLS_PER_HORIZON, HORIZON_MAX, HZ_MAX, Pace

TASKS_DEFAULT = 200
TASKS, ARRIVING, MEASURING, OUTPUT = "tasks", "arrivals", "measurement", "output"
PLANS, CALLS, STREAMS = "map and robot", "task", "stream of actions"
STREAM_TASK = "offboard.loadgen.robot.stream_policy:follow"
MAP_HELP = "map to drive on: ROS map.yaml or MovingAI .map"
TASK_HELP = "the @task function to call, with one whole number of --sizes or with the arguments of --inputs"


@dataclass(frozen=True, kw_only=True)
class Load:
    """How many tasks there are, when they start, and which are measured."""

    tasks: int | None = setting(
        None,
        f"number of tasks (default: {TASKS_DEFAULT}, or all inputs if they end earlier)",
        group=TASKS,
        minimum=1,
        maximum=1_000_000,
    )
    arrivals: str = setting(
        CLOSED,
        "closed: start the next task when the previous one finishes; others: start at --rate regardless",
        group=ARRIVING,
        choices=ARRIVALS,
    )
    rate: float | None = setting(
        None, "tasks per second, unless --arrivals is closed", group=ARRIVING, minimum=0.001, maximum=100_000
    )
    burst: int = setting(
        10,
        "with --arrivals bursts: tasks that start at the same time",
        group=ARRIVING,
        rare=True,
        minimum=1,
        maximum=1_000_000,
    )
    in_flight: int = setting(
        16,
        "unless --arrivals is closed: tasks that may run at the same time; further tasks start late",
        group=ARRIVING,
        rare=True,
        minimum=1,
        maximum=1024,
    )
    measure: int = setting(0, "run the first K tasks on both sites", group=MEASURING, rare=True, minimum=0)
    alone: int = setting(
        0,
        "after the run, measure K further tasks onboard alone, in the cloud alone and on both at once; "
        "writes NAME.alone.jsonl next to --trace",
        group=MEASURING,
        rare=True,
        minimum=0,
    )
    reference: int = setting(
        0,
        "run every K-th task again on each site alone; writes NAME.reference.jsonl next to --trace; "
        "0 is never",
        group=MEASURING,
        rare=True,
        minimum=0,
        maximum=1_000_000,
    )


# The help shows the fields of the last base class first.
@dataclass(frozen=True, kw_only=True)
class RobotConfig(Load, DecisionFlags, ServerFlags):
    """What `drive` and `call` have in common: one run of tasks, whatever they are."""

    seed: int = setting(1, "seed of everything that is drawn at random", group=TASKS, minimum=0)
    trace: Path | None = setting(None, "append one JSON line per task to this file", group=OUTPUT)
    answers: Path | None = setting(
        None,
        "append the answer of each task to this file as one JSON line; a run that finds answers there "
        "goes on after them",
        group=OUTPUT,
        rare=True,
    )
    metrics: str | None = setting(
        None, "serve Prometheus metrics at this address", group=OUTPUT, rare=True, metavar="HOST:PORT"
    )
    log: str = setting(
        "warning", "least severe messages that are logged", group=OUTPUT, rare=True, choices=LEVELS
    )
    log_format: str = setting(
        TEXT,
        "form of the lines of the log: text, or a JSON object each",
        group=OUTPUT,
        rare=True,
        choices=(TEXT, JSON),
    )

    def __post_init__(self) -> None:
        check(self)
        self.check_servers()
        self.check_decisions()
        self._check_run()
        if self.reference and self.changing:
            raise ConfigError(f"--reference: {self.reference} needs servers that stay, so no {self.changing}")
        if self.metrics is not None:
            address("--metrics", self.metrics)
        if self.memory is not None and self.memory in (self.trace, self.answers):
            raise ConfigError(f"--memory: {self.memory} is also the file of --trace or --answers")

    @property
    def tasks_max(self) -> int:
        """The number of tasks; without --tasks, inputs may end earlier."""
        return TASKS_DEFAULT if self.tasks is None else self.tasks

    def _check_run(self) -> None:
        if self.answers is not None and self.answers == self.trace:
            raise ConfigError(f"--answers: {self.answers} is also the file of --trace")
        for flag in ("measure", "alone"):
            if getattr(self, flag) > self.tasks_max:
                raise ConfigError(f"--{flag}: {getattr(self, flag)} is above --tasks {self.tasks_max}")
        for flag in ("alone", "reference"):
            for needed, value in (("trace", self.trace), ("cloud", self.cloud)):
                if getattr(self, flag) and value is None:
                    raise ConfigError(f"--{flag}: {getattr(self, flag)} needs --{needed}")
        if self.arrivals != CLOSED:
            self._check_open()
        elif self.rate is not None:
            raise ConfigError(f"--rate: {self.rate:g} needs --arrivals, which is {CLOSED} otherwise")

    def _check_open(self) -> None:
        if self.rate is None:
            raise ConfigError(f"--arrivals: {self.arrivals} needs --rate, the tasks per second")
        for flag in ("measure", "alone", "reference"):
            if getattr(self, flag):
                raise ConfigError(f"--{flag}: {getattr(self, flag)} needs --arrivals {CLOSED}")


@dataclass(frozen=True, kw_only=True)
class Planning:
    """The robot on a map, and the plans that it asks for."""

    map: Path | None = setting(None, MAP_HELP, group=PLANS)
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
    sizes: tuple[str, ...] = setting(
        (),
        f"input sizes; the robot picks goals that match them: {SIZES_ALLOWED}; repeat the flag for phases",
        group=PLANS,
        rare=True,
        metavar="SPEC",
    )


@dataclass(frozen=True, kw_only=True)
class DriveConfig(RobotConfig, Planning):
    """The settings of `loadgen drive`: a simulated robot asks for plans on a map."""

    map: Path = setting(REQUIRED, MAP_HELP, group=PLANS)
    picture: Path | None = setting(
        None,
        "draw the last plan with a path into this PNG file: map, robot, scan and path",
        group=PLANS,
        rare=True,
        metavar="FILE.png",
    )

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
class Streaming:
    """A stream of actions in place of single calls: each task is a step, and each input an observation."""

    stream_hz: float | None = setting(
        None,
        "play a stream of actions with this many steps per second; each task is a step, each input an "
        "observation",
        group=STREAMS,
        rare=True,
        minimum=0.001,
        maximum=HZ_MAX,
    )
    stream_horizon: int = setting(
        50, "actions in a chunk", group=STREAMS, rare=True, minimum=1, maximum=HORIZON_MAX
    )
    stream_calls_per_s: float | None = setting(
        None,
        f"most questions to each site per second (default: {CALLS_PER_HORIZON} in a horizon)",
        group=STREAMS,
        rare=True,
        minimum=0.0,
    )
    stream_blend: int = setting(
        BLEND, "steps in which the old actions turn into the new ones", group=STREAMS, rare=True, minimum=0
    )
    stream_onboard_ms: float = setting(
        350.0,
        f"with --task {STREAM_TASK}: how long the policy takes onboard",
        group=STREAMS,
        rare=True,
        minimum=0.0,
    )
    stream_cloud_ms: float = setting(100.0, "the same on a server", group=STREAMS, rare=True, minimum=0.0)


@dataclass(frozen=True, kw_only=True)
class Calling:
    """The task that is called, and its arguments."""

    task: str | None = setting(None, TASK_HELP, group=CALLS, metavar="MODULE:FUNCTION")
    inputs: str | None = setting(
        None,
        "function that takes the seed and returns an iterable of calls; each is a tuple of arguments, "
        "or the only argument",
        group=CALLS,
        metavar="MODULE:FUNCTION",
    )


@dataclass(frozen=True, kw_only=True)
class CallConfig(RobotConfig, Calling, Streaming):
    """The settings of `loadgen call`: any task, called with numbers or with inputs, or as a stream."""

    task: str = setting(REQUIRED, TASK_HELP, group=CALLS, metavar="MODULE:FUNCTION")
    sizes: tuple[str, ...] = setting(
        (), f"input sizes: {SIZES_ALLOWED}; repeat the flag for phases", group=CALLS, metavar="SPEC"
    )

    stream_rule: str = setting(
        STREAM, "when the stream asks for its next chunk", group=STREAMS, rare=True, choices=tuple(RULES)
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.stream_hz is not None:
            self._check_stream()
        if not self.sizes and self.inputs is None and not self.own_stream:
            raise ConfigError(f"--task: {self.task!r} needs --sizes or --inputs")
        if self.sizes and self.inputs is not None:
            raise ConfigError(f"--inputs: {self.inputs!r} cannot be combined with --sizes")
        parse_sizes(self.sizes)

    @property
    def own_stream(self) -> bool:
        """Whether the observations are those of `stream_policy`."""
        return self.stream_hz is not None and self.task == STREAM_TASK

    def _check_stream(self) -> None:
        try:
            Pace(self.stream_hz or 0.0, self.stream_horizon, self.stream_calls_per_s)
        except ConfigError as error:  # the others have limits of their own
            raise ConfigError(f"--stream-calls-per-s: {error}") from None
        if self.arrivals != CLOSED:
            raise ConfigError(f"--arrivals: {self.arrivals} cannot be combined with --stream-hz")
        for flag in ("measure", "alone", "reference"):
            if getattr(self, flag):
                raise ConfigError(f"--{flag}: {getattr(self, flag)} cannot be combined with --stream-hz")
