"""Scenarios: what a run on the testbed consists of, as data in a TOML file.

Who plays them is `play`; the machines they are played on are `testbed`.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from offboard.common.config import check, from_table, setting
from offboard.common.errors import ConfigError, DataError
from offboard.common.planning.planner_names import DIJKSTRA, PLANNERS
from offboard.common.toml_file import read_toml, unknown_key
from offboard.loadgen.relay.link.link_settings import LinkFlags
from offboard.loadgen.scenario.check import Check, check_computable, parse_checks
from offboard.loadgen.scenario.outcome import FIGURES
from offboard.loadgen.scenario.random_faults import Chaos
from offboard.loadgen.scenario.timeline import AT_TASK_MAX, Event, parse_events
from offboard.loadgen.testbed.cpu_quota import CPUS_MAX, CPUS_MIN
from offboard.loadgen.testbed.testbed import CLOUD, ROBOT, WAN
from offboard.robot_client import policies, predictors
from offboard.robot_client.simulated.config import CallConfig, DriveConfig, RobotConfig

SHIPPED = Path(__file__).parents[1] / "scenarios"
ROBOTS_MAX = 64
ARRIVALS = ("closed", "constant", "poisson", "bursts")
NAME = r"[A-Za-z0-9][A-Za-z0-9_-]*"
LINK_KEYS = tuple(f.name for f in fields(LinkFlags))


@dataclass(frozen=True)
class Workload:
    """`[workload]`: what robots ask for, and when. `map` and files of sizes are relative to the file."""

    map: Path | None = setting(None, "map.yaml or MovingAI .map to plan on")
    task: str | None = setting(None, "MODULE:FUNCTION in place of a map: a task of one number, its size")
    resolution: float | None = setting(
        None, "metres a cell to plan at, unless that of the map", minimum=0.001
    )
    planner: str = setting(DIJKSTRA, "how paths are searched", choices=PLANNERS)
    tasks: int = setting(200, "tasks of each robot", minimum=1, maximum=AT_TASK_MAX)
    sizes: tuple[str, ...] = setting((), "input sizes, as `robot-client --sizes` takes them")
    arrivals: str = setting("closed", "when the next task is due", choices=ARRIVALS)
    rate: float | None = setting(None, "tasks a second of each robot, unless arrivals are closed")
    burst: int = setting(10, "tasks at once, with bursts", minimum=1)
    in_flight: int = setting(16, "tasks of one robot at a time", minimum=1)
    robots: int = setting(1, "robots, each with its CPU quota", minimum=1, maximum=ROBOTS_MAX)
    jump: bool = setting(False, "the same tasks whatever was answered: the robot stands at each goal next")
    measure: int = setting(0, "the first K of them on both sites", minimum=0)
    alone: int = setting(0, "further plans: each on each site alone, and on both at once", minimum=0)
    reference: int = setting(0, "every K-th task of the first robot again on each site alone", minimum=0)
    deadline_ms: float | None = setting(None, "tasks that take longer are late", minimum=0.0)
    obstacles: int = setting(40, "boxes that the map lacks", minimum=0)
    radius_m: float = setting(0.15, "radius of the robot in metres", name="radius", minimum=0.0)

    def __post_init__(self) -> None:
        check(self)
        if (self.map is None) == (self.task is None):
            raise ConfigError("workload.map: either map or task is needed, and not both")
        if self.measure > self.tasks:
            raise ConfigError(f"workload.measure: {self.measure} is above workload.tasks {self.tasks}")
        if self.alone > self.tasks:
            raise ConfigError(f"workload.alone: {self.alone} is above workload.tasks {self.tasks}")

    def parts(self) -> tuple[str, ...]:
        """The parts of its run: cloud, relay, and the robots."""
        return (CLOUD, WAN, *(ROBOT if n == 1 else f"{ROBOT}-{n}" for n in range(1, self.robots + 1)))

    def robot(self, seed: int) -> RobotConfig:
        """The settings of a robot that asks for this; ConfigError where they contradict each other."""
        config = CallConfig if self.map is None else DriveConfig
        shared = {f.name for f in fields(config)} & {f.name for f in fields(self)}
        return config(
            **{name: getattr(self, name) for name in shared},
            seed=seed,
            cloud="tcp://relay:1",
            trace=Path("trace.jsonl"),
        )

    def known(self) -> dict[str, bool]:
        """The settings that some figures need, and whether they are there."""
        return {
            "jump": self.jump or self.map is None,
            "reference": self.reference > 0,
            "deadline": self.deadline_ms is not None,
        }


@dataclass(frozen=True)
class RobotPart:
    """`[robot]`: how it decides, and the CPU it has."""

    cpus: float = setting(0.2, "CPU quota", minimum=CPUS_MIN, maximum=CPUS_MAX)
    policy: str = setting("paper", f"where to run: {policies.HELP}")
    predictor: str | None = setting(
        None, f"how times are predicted, unless as the policy is meant: {predictors.HELP}"
    )
    window: int = setting(50, "executions remembered for each site", minimum=2)
    timeout_s: float = setting(2.0, "seconds to wait for a server", name="timeout", minimum=0.001)

    def __post_init__(self) -> None:
        check(self)
        policies.check_name(self.policy, "robot.policy")
        if self.predictor is not None:
            predictors.check_name(self.predictor, "robot.predictor")


@dataclass(frozen=True)
class CloudPart:
    """`[cloud]`: how the server runs tasks, and the CPU it has."""

    cpus: float = setting(1.0, "CPU quota", minimum=CPUS_MIN, maximum=CPUS_MAX)
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
    about: str = ""  # what it imitates, and what of the paper it tests
    robot: RobotPart = field(default_factory=RobotPart)
    cloud: CloudPart = field(default_factory=CloudPart)
    link: Mapping[str, Any] = field(default_factory=dict)
    events: tuple[Event, ...] = ()
    checks: tuple[Check, ...] = ()
    chaos: Chaos | None = None

    def timeline(self) -> tuple[Event, ...]:
        """All events: those that are named, and those drawn from the seed."""
        if self.chaos is None:
            return self.events
        assert self.workload.rate is not None, "checked when it was read"
        seconds = self.workload.tasks / self.workload.rate
        return self.events + self.chaos.events(self.seed, seconds, LinkFlags(**self.link).link)

    def robots(self) -> tuple[str, ...]:
        """The parts that are robots."""
        return self.workload.parts()[2:]

    def compared(self) -> tuple[str, ...]:
        """Robots whose times tell of their policy: the first, and all that are never paused.

        The others come and go to make load; a task that they were paused in takes as long as the pause.
        """
        paused = {event.value for event in self.timeline() if event.action == "pause"}
        return tuple(robot for robot in self.robots() if robot == ROBOT or robot not in paused)

    def changed(
        self,
        *,
        seed: int | None = None,
        tasks: int | None = None,
        measure_all: bool = False,
        alone: int | None = None,
        reference: int | None = None,
        policy: str | None = None,
        predictor: str | None = None,
    ) -> "Scenario":
        """The same with another seed, number of tasks, policy or predictor, or every task on both sites.

        Another policy goes by its own predictor, unless one is named. Without a reference (0) there are no
        checks that need one.
        """
        count = self.workload.tasks if tasks is None else tasks
        measure = count if measure_all else min(self.workload.measure, count)
        alone = min(self.workload.alone if alone is None else alone, count)
        workload = replace(self.workload, tasks=count, measure=measure, alone=alone)
        if reference is not None:
            workload = replace(workload, reference=reference)
        workload.robot(self.seed)
        robot = self.robot
        if policy is not None:
            robot = replace(robot, policy=policy, predictor=predictor)
        elif predictor is not None:
            robot = replace(robot, predictor=predictor)
        checks = self.checks
        if reference == 0:
            checks = tuple(one for one in checks if FIGURES[one.figure].needs != "reference")
        for one in checks:
            check_computable(one, tasks=count, known=workload.known())
        return replace(
            self,
            seed=self.seed if seed is None else seed,
            workload=workload,
            robot=robot,
            checks=checks,
        )


def read_scenario(path: Path) -> Scenario:
    """The scenario in a TOML file; DataError names file and key where it is wrong."""
    table = read_toml(path)
    known = [{"events": "event", "checks": "check"}.get(f.name, f.name) for f in fields(Scenario)]
    for key in table:
        if key not in known:
            raise unknown_key(path, key, known)
    name, seed = table.get("name"), table.get("seed", 1)
    if not isinstance(name, str) or not re.fullmatch(NAME, name):
        said = f"name = {name!r} is not a word of letters, digits, _ and -"
        raise DataError(f"{path}: {said}" if name else f"{path}: name is missing")
    if type(seed) is not int or seed < 0:
        raise DataError(f"{path}: seed = {seed!r} is not a whole number from 0")
    workload = _workload(_table(table, "workload", path), path)
    link = _link(_table(table, "link", path), path)
    return Scenario(
        name,
        seed,
        workload,
        str(table.get("about", "")).strip(),
        from_table(RobotPart, _table(table, "robot", path), path, "robot"),
        from_table(CloudPart, _table(table, "cloud", path), path, "cloud"),
        link,
        parse_events(table, path, workload.parts(), from_table(LinkFlags, link, path, "link").link),
        parse_checks(table, path, tasks=workload.tasks, known=workload.known()),
        _chaos(table, workload, path),
    )


def find_scenario(name: str) -> Path:
    """A file, or the name of a scenario that comes with the bench."""
    for path in (Path(name), SHIPPED / f"{name}.toml"):
        if path.is_file():
            return path
    raise DataError(f"scenario {name!r} is neither a file nor one of {', '.join(shipped())}")


def shipped() -> tuple[str, ...]:
    """The names of the scenarios that come with the bench."""
    return tuple(sorted(path.stem for path in SHIPPED.glob("*.toml")))


def _table(table: Mapping[str, Any], section: str, path: Path) -> Mapping[str, Any]:
    found = table.get(section, {})
    if not isinstance(found, dict):
        raise DataError(f"{path}: {section} is not a table")
    return found


def _workload(table: Mapping[str, Any], path: Path) -> Workload:
    workload = from_table(Workload, table, path, "workload")
    try:
        workload.robot(seed=0)
    except ConfigError as error:
        raise DataError(f"{path}: workload: {error}") from None
    workload = replace(workload, sizes=_sizes(workload.sizes, path))
    if workload.map is None:
        return workload
    place = (path.parent / workload.map).resolve()
    if not place.is_file():
        raise DataError(f"{path}: workload.map: {place}: no such file")
    return replace(workload, map=place)


def _sizes(texts: tuple[str, ...], path: Path) -> tuple[str, ...]:
    """A file of sizes by its whole path; it stands alone."""
    files = [text for text in texts if text.endswith(".csv")]
    if not files:
        return texts
    place = (path.parent / files[0]).resolve()
    if len(texts) > 1 or not place.is_file():
        wrong = "no such file" if len(texts) == 1 else "a file of sizes holds for all tasks, and stands alone"
        raise DataError(f"{path}: workload.sizes: {files[0]}: {wrong}")
    return (str(place),)


def _chaos(table: Mapping[str, Any], workload: Workload, path: Path) -> Chaos | None:
    if "chaos" not in table:
        return None
    if workload.rate is None:
        raise DataError(f"{path}: chaos: faults by the second need arrivals that are not closed")
    return from_table(Chaos, _table(table, "chaos", path), path, "chaos")


def _link(table: Mapping[str, Any], path: Path) -> Mapping[str, Any]:
    for key in table:
        if key not in LINK_KEYS:
            raise unknown_key(path, key, LINK_KEYS)
    table = {
        key: (path.parent / str(value)).resolve() if key.endswith("samples") else value
        for key, value in table.items()
    }
    from_table(LinkFlags, table, path, "link")
    return table
