"""`loadgen dataset`: measures the tasks of a scenario on both sites and records how they were measured.

NAME.csv holds the rows; NAME.json holds machine, Table I, settings, commit, disturbance and CPU use.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from offboard.common import VERSION
from offboard.common.config import check, setting
from offboard.loadgen.play.code_commit import commit_here
from offboard.loadgen.play.machine import docker_version, machine
from offboard.loadgen.play.play_scenario import TESTBEDS, play
from offboard.loadgen.play.run_files import TRACE
from offboard.loadgen.play.table_one import specifications, table_one
from offboard.loadgen.replay.dataset_file import measured_tasks, read_recorded, write_dataset
from offboard.loadgen.scenario.scenario import Scenario, Workload
from offboard.loadgen.scenario.scenario_file import check_calls, find_scenario, read_scenario
from offboard.loadgen.table.measured_rows import write_whole
from offboard.loadgen.table.measurement_notes import disturbance, read_noted
from offboard.loadgen.table.table_formats import render
from offboard.robot_client import policies

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
    started_at, commit = datetime.now(UTC), commit_here()
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


def _conditions(scenario: Scenario, testbed: str) -> str:
    """One line that says where and how the rows were measured."""
    workload, link = scenario.workload, ", ".join(f"{key} {value}" for key, value in scenario.link.items())
    return (
        f"Measured on the {testbed} testbed: {_asked(workload)}, "
        f"seed {scenario.seed}, robot {scenario.robot.cpus:g} CPU, link {link or 'direct'}."
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
    return settings
