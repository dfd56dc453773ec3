"""`loadgen dataset`: measures the tasks of a scenario on both sites and records how they were measured.

NAME.csv holds the rows; NAME.json holds machine, Table I, settings, commit, disturbance and CPU use.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, ClassVar

from offboard.common import VERSION
from offboard.common.config import check, setting
from offboard.loadgen.play.machine import commit_here, docker_version, machine, output_of
from offboard.loadgen.play.part_setups import setups
from offboard.loadgen.play.play_scenario import TESTBEDS, play
from offboard.loadgen.play.run_files import TRACE
from offboard.loadgen.replay.dataset_file import measured_tasks, read_recorded, write_dataset
from offboard.loadgen.scenario.scenario import Scenario, Workload
from offboard.loadgen.scenario.scenario_file import check_calls, find_scenario, read_scenario
from offboard.loadgen.table.measured_rows import write_whole
from offboard.loadgen.table.measurement_notes import disturbance, read_noted
from offboard.loadgen.table.table_formats import Heading, Table, render
from offboard.loadgen.testbed.container_part import IMAGES, service_of
from offboard.loadgen.testbed.testbed import CLOUD, ROBOT
from offboard.robot_client import policies

SYSTEM = "import platform as p; print(p.freedesktop_os_release()['PRETTY_NAME'], p.python_version(), sep='|')"
TABLE_ONE = {
    "what": Heading("", "", None),
    "robot": Heading("robot", "robot", None),
    "cloud": Heading("cloud", "cloud", None),
}
POLICY = policies.ALIAS  # its traces hold features and work; where a row runs is not up to the policy


@dataclass(frozen=True)
class DatasetConfig:
    """What is measured, and where the files go."""

    out: Path = setting(Path("out/datasets"), "folder for NAME.csv and NAME.json", metavar="DIR")
    run: Path = setting(
        Path("out/dataset"), "folder for the files of the run, such as NAME/trace.jsonl", metavar="DIR"
    )
    testbed: str = setting(
        "docker", "where to measure: in local processes or in Docker containers", choices=tuple(TESTBEDS)
    )
    rows: int = setting(1000, "number of tasks; each runs on both sites", minimum=1)
    alone: int = setting(
        100, "number of extra tasks that measure how much the two sites disturb each other", minimum=0
    )
    seed: int | None = setting(None, "random seed (default: the scenario's seed)", minimum=0)

    def __post_init__(self) -> None:
        check(self)


def run_dataset(name: str, config: DatasetConfig, command: Sequence[str]) -> int:
    """Play the scenario, then write both files. `command` is the command line, recorded in NAME.json."""
    path = find_scenario(name)
    scenario = read_scenario(path).changed(
        seed=config.seed, tasks=config.rows, measure_all=True, alone=config.alone, policy=POLICY
    )
    check_calls(scenario, path)
    run = config.run / scenario.name
    started_at, commit = datetime.now(timezone.utc), commit_here()
    play(scenario, run, config.testbed).check_robots()
    rows, disturbed = read_noted(run / TRACE), disturbance(run / TRACE)
    this = machine() | ({"docker": docker_version()} if config.testbed == "docker" else {})
    specified = specifications(this, scenario, run)
    about = {
        "name": scenario.name,
        "measured_at": started_at.isoformat(timespec="seconds"),
        "command": " ".join(command),
        "commit": commit,
        "software": VERSION,
        "testbed": config.testbed,
        "machine": this,
        "table_one": [asdict(line) for line in specified],
        "scenario": _settings(scenario),
        "rows": len(rows),
        "left_out": rows.left_out,
        "notes": [_conditions(scenario, config.testbed), *rows.notes],
        "disturbance": disturbed.as_dict() if disturbed else None,
    }
    path = config.out / f"{scenario.name}.csv"
    tasks = measured_tasks(read_recorded(run / TRACE, None))
    write_whole(path.with_suffix(".json"), json.dumps(about, indent=2, ensure_ascii=False) + "\n")
    write_dataset(path, tasks)  # last, so that no rows are without their machine
    print(f"\n{render([table_one(scenario.name, specified)], 'md')}")
    print(f"written: {path} ({len(rows)} rows, {rows.left_out} left out) and {path.with_suffix('.json')}")
    return 0


@dataclass(frozen=True, slots=True)
class Specification:
    """One line of Table I: the same thing of both parts."""

    what: str
    robot: str
    cloud: str
    note: ClassVar[str] = ""


def table_one(name: str, lines: Sequence[Specification]) -> Table:
    """What robot and cloud of the dataset ran on, as in Table I of the paper."""
    return Table(f"Table I of {name}: robot and cloud.", {"dataset": name}, TABLE_ONE, lines)


def specifications(this: Mapping[str, Any], scenario: Scenario, run: Path) -> list[Specification]:
    """Both parts are on `this` machine, in containers if it names a version of Docker."""
    cloud = next(server for server in scenario.servers if server.name == CLOUD)
    docker = this.get("docker")
    inside = [this, this]
    if docker is not None:
        parts = setups(scenario, run)
        inside = [_system_in(service_of(part, parts[part])) for part in (ROBOT, CLOUD)]
    runs_in = "a process" if docker is None else f"a container of Docker {docker}"
    cores, memory = f"{this['cores']}, shared", f"{this['memory_gib']:g} GiB, shared"
    quotas = f"{scenario.robot.cpus:g} CPU", f"{cloud.cpus:g} CPU"
    systems, pythons = ([str(one[key] or "unknown") for one in inside] for key in ("system", "python"))
    return [
        Specification("processor", this["cpu"], this["cpu"]),
        Specification("cores", cores, cores),
        Specification("CPU quota", *quotas),
        Specification("RAM", memory, memory),
        Specification("GPU", this["gpu"], this["gpu"]),
        Specification("runs in", runs_in, runs_in),
        Specification("system", *systems),
        Specification("kernel", this["kernel"], this["kernel"]),
        Specification("Python", *pythons),
    ]


def _system_in(service: str) -> dict[str, str | None]:
    """System and Python inside the image of a Compose service; None: unknown."""
    run = ("docker", "run", "--rm", "--network", "none", "--entrypoint", "python3")
    system, _, python = (output_of((*run, IMAGES[service], "-c", SYSTEM)) or "").partition("|")
    return {"system": system or None, "python": python or None}


def _conditions(scenario: Scenario, testbed: str) -> str:
    """One line that says where and how the rows were measured."""
    workload = scenario.workload
    link = ", ".join(f"{key} {_named(value)}" for key, value in scenario.link.items())
    cloud = next(server for server in scenario.servers if server.name == CLOUD)
    others = f", with {workload.robots - 1} more robots" if workload.robots > 1 else ""
    events = f", {len(scenario.events)} events" if scenario.events else ""
    return (
        f"Measured on the {testbed} testbed: {_asked(workload)}, "
        f"seed {scenario.seed}, robot {scenario.robot.cpus:g} CPU, cloud {cloud.cpus:g} CPU{others}{events}, "
        f"link {link or 'direct'}."
    )


def _asked(workload: Workload) -> str:
    if workload.map is None:
        given = f"inputs {workload.inputs}" if workload.inputs else f"sizes {','.join(workload.sizes)}"
        return f"task {workload.task}, {given}"
    cells = "" if workload.resolution is None else f" at {workload.resolution:g} m"
    return f"{workload.map.name}{cells}"


def _settings(scenario: Scenario) -> dict[str, Any]:
    settings = asdict(scenario)
    if scenario.workload.map:
        settings["workload"]["map"] = scenario.workload.map.name
    for of in (settings, *settings["servers"]):
        of["link"] = {key: _named(value) for key, value in of["link"].items()}
    return settings


def _named(value: Any) -> Any:
    """The name of a file: where it lies on this computer says nothing elsewhere."""
    return value.name if isinstance(value, Path) else value
