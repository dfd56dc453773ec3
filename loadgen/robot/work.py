"""The tasks of a run, one after the other: plans for a robot on a map, or the calls of `calls`.

When they are asked for is up to `run`; where they run is up to the offloader.
"""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from offboard.loadgen.robot import answers
from offboard.loadgen.robot.calls import make_calls
from offboard.loadgen.robot.config import CallConfig, DriveConfig, RobotConfig
from offboard.loadgen.robot.workload import parse_sizes, sizes

if TYPE_CHECKING:  # importing the planner compiles it, which only a run on a map needs
    from offboard.common.planning.maps import GridMap
    from offboard.loadgen.robot.robot import SimulatedRobot


class Work(Protocol):
    """The tasks of one run in their order, for one thread at a time.

    `noun` is what a task is called in the summary, `found` what a good answer brings (None: nothing to say).
    If the work is `independent`, its tasks do not depend on earlier answers.
    If it is `large`, its arguments may be megabytes each, so few tasks are made ahead.
    """

    function: Callable[..., Any]
    noun: str
    found: str | None
    independent: bool
    large: bool

    def request(self) -> tuple[Any, ...]:
        """The arguments of the present task; a second call returns the same. InputsEnded if there is none."""

    def advance(self, answer: Any) -> None:
        """Go on to the next task; `answer` is None if the present task was not asked for, or failed."""

    def got(self, answer: Any) -> bool:
        """Whether the answer counts as `found`."""

    def describe(self, answer: Any) -> dict[str, Any]:
        """The answer as the answers file holds it; raises an OffloadError if it cannot be written there."""


class Plans:
    """Plans for a robot, which drives each answer, or jumps to its goal without waiting for the answer.

    `wanted` gives the input size of each task from the second on; without it, goals are near and far.
    """

    noun = "plans"
    found: str | None = "a path was found"
    large = False

    def __init__(self, robot: "SimulatedRobot", wanted: Iterator[float] | None, *, jump: bool) -> None:
        from offboard.common.planning.planner import plan_path

        self.function: Callable[..., Any] = plan_path
        self.robot = robot
        self.independent = jump
        self._wanted = wanted

    def request(self) -> tuple[Any, ...]:
        return self.robot.request()

    def advance(self, answer: Any) -> None:
        size = next(self._wanted) if self._wanted else None
        if self.independent:
            self.robot.jump(size)
        elif answer is None:
            self.robot.give_up_goal(size)
        else:
            self.robot.drive(answer, size)

    def got(self, answer: Any) -> bool:
        return bool(answer.status == "NONE")

    def describe(self, answer: Any) -> dict[str, Any]:
        return answers.of_plan(answer)


def make_work(config: RobotConfig) -> Work:
    """The work that the settings ask for; a ConfigError or DataError if it cannot be made."""
    if isinstance(config, CallConfig):
        return make_calls(config)
    assert isinstance(config, DriveConfig)
    return make_plans(config, read_prior(config.map, config.resolution))


def make_plans(config: DriveConfig, prior: "GridMap") -> Plans:
    """The plans of a robot that was given the map `prior`."""
    from offboard.loadgen.robot.robot import SimulatedRobot

    wanted = sizes(parse_sizes(config.sizes), config.seed) if config.sizes else None
    robot = SimulatedRobot(
        prior,
        seed=config.seed,
        obstacles=config.obstacles,
        radius_m=config.radius_m,
        planner=config.planner,
        size=next(wanted) if wanted else None,
    )
    return Plans(robot, wanted, jump=config.jump)


def read_prior(path: Path, resolution: float | None) -> "GridMap":
    """The map that the robot is given, in cells of `resolution` metres (None: those of the file).

    A MovingAI map keeps its cells.
    """
    from offboard.common.planning.map_files import read_map
    from offboard.common.planning.maps import resampled

    grid = read_map(path)
    return grid if resolution is None or path.suffix == ".map" else resampled(grid, resolution)
