"""The parameters of the planner server, with the names of nav2.

`node` declares them in ROS; `bridge` reads them from the command line.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from offboard.common.errors import ConfigError

PARAMETER_FLAGS = ("-p", "--param")


@dataclass(frozen=True, slots=True)
class Parameters:
    """What a plan and its topics depend on.

    radius_m: of the robot. tolerance_m: how far from an occupied goal a path may end.
    planners: the planner ids that goals may ask for. frame: of the map. robot_frame: of the robot.
    action: its name. costmap: the map is nav2's costmap. scan_topic: empty for no scan.
    """

    radius_m: float
    tolerance_m: float
    planners: tuple[str, ...]
    frame: str
    action: str
    robot_frame: str
    allow_unknown: bool
    map_topic: str
    costmap: bool
    scan_topic: str

    @classmethod
    def read(cls, declare: Callable[[str, Any], Any]) -> "Parameters":
        """`declare` gets the name and the default of a parameter, and returns its value."""
        planners = tuple(declare("planner_plugins", ["GridBased"]))
        if not planners:
            raise ConfigError("planner_plugins: it is empty; it must name a planner")
        return cls(
            radius_m=_distance(declare, "robot_radius", 0.1),
            tolerance_m=_distance(declare, f"{planners[0]}.tolerance", 0.5),
            planners=planners,
            frame=declare("global_frame", "map"),
            action=declare("action_name", "compute_path_to_pose"),
            robot_frame=declare("robot_base_frame", "base_link"),
            allow_unknown=declare(f"{planners[0]}.allow_unknown", True),
            map_topic=declare("map_topic", "map"),
            costmap=declare("costmap", False),
            scan_topic=declare("scan_topic", "scan"),
        )


def read_arguments(arguments: Sequence[str]) -> Parameters:
    """The parameters from `--ros-args -p NAME:=VALUE ..`, for a process without ROS."""
    given: dict[str, str] = {}
    words = [word for word in arguments if word != "--ros-args"]
    for flag, text in zip(words[::2], [*words[1::2], ""], strict=False):
        name, assigned, value = text.partition(":=")
        if flag not in PARAMETER_FLAGS or not assigned:
            raise ConfigError(f"--ros-args: {flag} {text}: only -p NAME:=VALUE is read without ROS")
        given[name] = value
    known: list[str] = []

    def declare(name: str, default: Any) -> Any:
        known.append(name)
        return _value(name, default, given[name]) if name in given else default

    parameters = Parameters.read(declare)
    for name in given:
        if name not in known:
            raise ConfigError(f"--ros-args: no parameter {name!r}; known: {', '.join(known)}")
    return parameters


def _distance(declare: Callable[[str, Any], Any], name: str, default: float) -> float:
    value = float(declare(name, default))
    if not 0 <= value < float("inf"):
        raise ConfigError(f"{name}: {value:g} is not a distance in metres")
    return value


def _value(name: str, default: Any, text: str) -> Any:
    """A text of the command line as a value of the type of the default."""
    if isinstance(default, list):
        return [part.strip(" \"'") for part in text.strip("[]").split(",") if part.strip()]
    if isinstance(default, bool):
        if text.lower() not in ("true", "false"):
            raise ConfigError(f"{name}: {text!r} is not true or false")
        return text.lower() == "true"
    if isinstance(default, float):
        try:
            return float(text)
        except ValueError:
            raise ConfigError(f"{name}: {text!r} is not a number") from None
    return text
