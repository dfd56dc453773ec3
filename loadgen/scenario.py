"""Scenarios: what a run on the testbed consists of, as data in a TOML file.

Who plays them is `play`; the machines they are played on are `testbed`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from common.config import REQUIRED, check, from_table, read_toml, setting, unknown_key
from common.errors import ConfigError, DataError
from loadgen.flags import LinkFlags
from loadgen.quota import CPUS_MAX, CPUS_MIN
from loadgen.wan import WanConfig
from robot_client import policies, predictors

LINK_KEYS = tuple(f.name for f in fields(LinkFlags))


@dataclass(frozen=True)
class Workload:
    """`[workload]`: the plans to make. `map` is relative to the scenario's file."""

    map: Path = setting(REQUIRED, "map.yaml or MovingAI .map")
    resolution: float = setting(0.025, "metres a cell to plan at", minimum=0.001)
    tasks: int = setting(200, "plans to make", minimum=1)
    measure: int = setting(0, "the first K of them on both sites", minimum=0)
    alone: int = setting(0, "further plans: each on each site alone, and on both at once", minimum=0)
    obstacles: int = setting(40, "boxes that the map lacks", minimum=0)
    radius_m: float = setting(0.15, "radius of the robot in metres", name="radius", minimum=0.0)

    def __post_init__(self) -> None:
        check(self)
        if self.measure > self.tasks:
            raise ConfigError(f"workload.measure: {self.measure} is above workload.tasks {self.tasks}")
        if self.alone > self.tasks:
            raise ConfigError(f"workload.alone: {self.alone} is above workload.tasks {self.tasks}")


@dataclass(frozen=True)
class RobotPart:
    """`[robot]`: how it decides, and the CPU it has."""

    cpus: float = setting(0.2, "CPU quota", minimum=CPUS_MIN, maximum=CPUS_MAX)
    policy: str = setting("paper", "where to run", choices=policies.names())
    predictor: str = setting(predictors.LEAST_SQUARES, f"how times are predicted: {predictors.HELP}")
    window: int = setting(50, "executions remembered for each site", minimum=2)
    timeout_s: float = setting(2.0, "seconds to wait for a server", name="timeout", minimum=0.001)

    def __post_init__(self) -> None:
        check(self)
        predictors.check_name(self.predictor, "robot.predictor")


@dataclass(frozen=True)
class CloudPart:
    """`[cloud]`: how the server runs tasks."""

    executor: str = setting("threads", "where tasks run", choices=("threads", "processes"))
    workers: int = setting(1, "tasks at a time", minimum=1)

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True)
class Scenario:
    """A whole run; `[link]` holds the conditions of `loadgen wan` under their flag names."""

    name: str
    seed: int
    workload: Workload
    robot: RobotPart = field(default_factory=RobotPart)
    cloud: CloudPart = field(default_factory=CloudPart)
    link: Mapping[str, Any] = field(default_factory=dict)

    def changed(
        self, *, seed: int | None, tasks: int | None, measure_all: bool, alone: int | None = None
    ) -> "Scenario":
        """The same with another seed or number of tasks, or every task on both sites."""
        count = self.workload.tasks if tasks is None else tasks
        measure = count if measure_all else min(self.workload.measure, count)
        alone = min(self.workload.alone if alone is None else alone, count)
        workload = replace(self.workload, tasks=count, measure=measure, alone=alone)
        return replace(self, seed=self.seed if seed is None else seed, workload=workload)


def read_scenario(path: Path) -> Scenario:
    """The scenario in a TOML file; DataError names file and key where it is wrong."""
    table = read_toml(path)
    known = [f.name for f in fields(Scenario)]
    for key in table:
        if key not in known:
            raise unknown_key(path, key, known)
    name, seed = table.get("name"), table.get("seed", 1)
    if not isinstance(name, str) or not name.isidentifier():
        raise DataError(f"{path}: name = {name!r} is not a word" if name else f"{path}: name is missing")
    if type(seed) is not int or seed < 0:
        raise DataError(f"{path}: seed = {seed!r} is not a whole number from 0")
    workload = from_table(Workload, _table(table, "workload", path), path, "workload")
    workload = replace(workload, map=(path.parent / workload.map).resolve())
    if not workload.map.is_file():
        raise DataError(f"{path}: workload.map: {workload.map}: no such file")
    return Scenario(
        name,
        seed,
        workload,
        from_table(RobotPart, _table(table, "robot", path), path, "robot"),
        from_table(CloudPart, _table(table, "cloud", path), path, "cloud"),
        _link(_table(table, "link", path), path),
    )


def find_scenario(name: str) -> Path:
    """A file, or the name of a scenario that comes with the bench."""
    shipped = Path(__file__).parent / "scenarios"
    for path in (Path(name), shipped / f"{name}.toml"):
        if path.is_file():
            return path
    names = ", ".join(sorted(path.stem for path in shipped.glob("*.toml")))
    raise DataError(f"scenario {name!r} is neither a file nor one of {names}")


def _table(table: Mapping[str, Any], section: str, path: Path) -> Mapping[str, Any]:
    found = table.get(section, {})
    if not isinstance(found, dict):
        raise DataError(f"{path}: {section} is not a table")
    return found


def _link(table: Mapping[str, Any], path: Path) -> Mapping[str, Any]:
    for key in table:
        if key not in LINK_KEYS:
            raise unknown_key(path, key, LINK_KEYS)
    table = {
        key: (path.parent / str(value)).resolve() if key.endswith("samples") else value
        for key, value in table.items()
    }
    from_table(WanConfig, {key.replace("_", "-"): value for key, value in table.items()}, path, "link")
    return table
