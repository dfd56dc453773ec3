"""`loadgen dataset`: measures a scenario's plans on both sites, and writes down how they were measured.

NAME.csv holds the rows, NAME.json the machine, the settings, the commit, the disturbance and the use of CPU.
"""

import json
import os
import platform
import subprocess
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from offboard.common import VERSION
from offboard.common.config import REQUIRED, check, setting
from offboard.loadgen.play.play import TESTBEDS, play
from offboard.loadgen.play.player import TRACE
from offboard.loadgen.scenario.scenario import Scenario, Workload, find_scenario, read_scenario
from offboard.loadgen.table.notes import disturbance, read_noted
from offboard.loadgen.table.rows import read, write_csv, write_whole

ASK_S = 10


@dataclass(frozen=True)
class DatasetConfig:
    """What is measured, and where the files go."""

    out: Path = setting(Path("out/datasets"), "folder for NAME.csv and NAME.json", metavar="DIR")
    run: Path = setting(Path("out/dataset"), "folder for the run itself: NAME/trace.jsonl", metavar="DIR")
    testbed: str = setting("docker", "where it is measured", choices=tuple(TESTBEDS))
    rows: int = setting(1000, "plans, each on both sites", minimum=1)
    alone: int = setting(100, "further plans that tell how much the two sites disturb each other", minimum=0)
    seed: int | None = setting(None, "instead of the scenario's own", minimum=0)

    def __post_init__(self) -> None:
        check(self)


def run_dataset(name: str, config: DatasetConfig, command: Sequence[str]) -> int:
    """Play the scenario, then write both files; `command` is how this was called."""
    scenario = read_scenario(find_scenario(name))
    scenario = scenario.changed(seed=config.seed, tasks=config.rows, measure_all=True, alone=config.alone)
    run = config.run / scenario.name
    started_at, commit = datetime.now(UTC), _commit()
    play(scenario, run, config.testbed).check_robots()
    rows, disturbed = read_noted(run / TRACE), disturbance(run / TRACE)
    about = {
        "name": scenario.name,
        "measured_at": started_at.isoformat(timespec="seconds"),
        "command": " ".join(command),
        "commit": commit,
        "software": VERSION,
        "testbed": config.testbed,
        "machine": _machine(config.testbed),
        "scenario": _settings(scenario),
        "rows": len(rows),
        "left_out": rows.left_out,
        "notes": [_conditions(scenario, config.testbed), *rows.notes],
        "disturbance": disturbed.as_dict() if disturbed else None,
    }
    path = config.out / f"{scenario.name}.csv"
    write_csv(path, rows)
    write_whole(path.with_suffix(".json"), json.dumps(about, indent=2, ensure_ascii=False) + "\n")
    print(f"written: {path} ({len(rows)} rows, {rows.left_out} left out) and {path.with_suffix('.json')}")
    return 0


@dataclass(frozen=True)
class ExportConfig:
    """What of a trace is written, and where to."""

    csv: Path = setting(REQUIRED, "file to write, replaced if it is there", metavar="FILE")
    kind: str | None = setting(None, "kind of task, where a trace holds several")

    def __post_init__(self) -> None:
        check(self)


def run_export(path: Path, config: ExportConfig) -> int:
    """Write the tasks of a trace that ran on both sites as a dataset."""
    rows = read(path, config.kind)
    write_csv(config.csv, rows)
    left_out = f", {rows.left_out} tasks without both times left out" if rows.left_out else ""
    print(f"written: {config.csv} ({len(rows)} rows{left_out})")
    return 0


def _conditions(scenario: Scenario, testbed: str) -> str:
    """Where and how the rows were measured, in one line."""
    workload, link = scenario.workload, ", ".join(f"{key} {value}" for key, value in scenario.link.items())
    return (
        f"Measured on the {testbed} testbed: {_asked(workload)}, "
        f"seed {scenario.seed}, robot {scenario.robot.cpus:g} CPU, link {link or 'direct'}."
    )


def _asked(workload: Workload) -> str:
    if workload.map is None:
        return f"task {workload.task}, sizes {','.join(workload.sizes)}"
    cells = "" if workload.resolution is None else f" at {workload.resolution:g} m"
    return f"{workload.map.name}{cells}"


def _settings(scenario: Scenario) -> dict[str, Any]:
    settings = asdict(scenario)
    if scenario.workload.map:
        settings["workload"]["map"] = scenario.workload.map.name
    return settings


def _machine(testbed: str) -> dict[str, Any]:
    machine = {
        "cpu": _cpu_model(),
        "cores": os.cpu_count(),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "python": platform.python_version(),
    }
    if testbed == "docker":
        machine["docker"] = _said("docker", "version", "--format", "{{.Server.Version}}")
    return machine


def _cpu_model() -> str:
    """As the kernel calls it; the architecture where it does not."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    models = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(models, platform.machine())


def _commit() -> str | None:
    """Of the checkout in the current folder, marked where files differ from it."""
    return _said("git", "describe", "--always", "--dirty", "--abbrev=12")


def _said(*command: str) -> str | None:
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=ASK_S, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() or None
