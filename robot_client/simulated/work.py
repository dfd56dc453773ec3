"""The tasks of a run, one after the other: plans for a robot on a map, or calls of a function with a size.

When they are asked for is up to `run`; where they run is up to the offloader.
"""

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from offboard.common.errors import ConfigError, OffloadError
from offboard.common.tasks import Kind, kind_of, load_modules
from offboard.robot_client.simulated import answers
from offboard.robot_client.simulated.config import CallConfig, DriveConfig, RobotConfig
from offboard.robot_client.simulated.workload import parse_sizes, sizes

if TYPE_CHECKING:  # importing the planner compiles it, which only a run on a map needs
    from offboard.common.planning.maps import GridMap
    from offboard.robot_client.simulated.robot import SimulatedRobot

TASK_ALLOWED = "MODULE:FUNCTION with a @task function of one number"


class Work(Protocol):
    """The tasks of one run in their order, for one thread at a time.

    `noun` is what a task is called in the summary, `found` what a good answer brings (None: nothing to say).
    If the work is `independent`, its tasks do not depend on earlier answers.
    """

    function: Callable[..., Any]
    noun: str
    found: str | None
    independent: bool

    def request(self) -> tuple[Any, ...]:
        """The arguments of the present task; a second call returns the same."""

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


class Calls:
    """Calls of a `@task` function, each with the next whole number of `wanted`."""

    noun = "tasks"
    found: str | None = None
    independent = True

    def __init__(self, function: Callable[..., Any], wanted: Iterator[float]) -> None:
        self.function = function
        self._types = kind_of(function).types
        self._wanted = wanted
        self._size = next(wanted)

    def request(self) -> tuple[Any, ...]:
        return (int(self._size),)

    def advance(self, answer: Any) -> None:  # noqa: ARG002 - no call depends on an answer
        self._size = next(self._wanted)

    def got(self, answer: Any) -> bool:  # noqa: ARG002 - every answer counts
        return True

    def describe(self, answer: Any) -> dict[str, Any]:
        return answers.of_value(answer, self._types)


def make_work(config: RobotConfig) -> Work:
    """The work that the settings ask for; a ConfigError or DataError if it cannot be made."""
    if isinstance(config, CallConfig):
        function = _find_task(config.task)
        _check_repeats(config, kind_of(function))
        return Calls(function, sizes(parse_sizes(config.sizes), config.seed))
    from offboard.robot_client.simulated.robot import SimulatedRobot

    assert isinstance(config, DriveConfig)
    wanted = sizes(parse_sizes(config.sizes), config.seed) if config.sizes else None
    robot = SimulatedRobot(
        read_prior(config.map, config.resolution),
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


def _find_task(name: str) -> Callable[..., Any]:
    """The function of `--task`."""
    module, _, function_name = name.partition(":")
    try:
        if not (module and function_name):
            raise ConfigError("one of the two is missing")
        load_modules([module])
        function = getattr(sys.modules[module], function_name, None)
        if not callable(function):
            raise ConfigError(f"{module} has no function {function_name!r}")
        kind_of(function).signature().bind(0)
    except (OffloadError, TypeError) as error:
        raise ConfigError(f"--task: {name!r} is not {TASK_ALLOWED}: {error}") from error
    return kind_of(function).function


def _check_repeats(config: RobotConfig, kind: Kind) -> None:
    """A ConfigError if the settings run a task twice that must not run twice."""
    for flag in ("measure", "alone", "reference"):
        if getattr(config, flag) and not kind.duplicate:
            raise ConfigError(
                f"--{flag}: {getattr(config, flag)}: task {kind.name} is declared duplicate=False"
            )
