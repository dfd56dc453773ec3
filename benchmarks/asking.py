"""Measures `expect`, deadlines and `observe` with the applications of examples/, on the local testbed.

    .cache/examples/bin/python -m benchmarks.asking

Use a machine with nothing else to do: the figures of a busy one say nothing. Each application is played in
its scenario `calm`. Without a library, its application is left out. A run that was played stays in --out and
is read again; delete the folder to play it again.
"""

import argparse
import os
import platform
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.application_runs import find_kind
from benchmarks.applications import CALM, NAMES
from benchmarks.asking_robot import ASK, OBSERVE
from benchmarks.asking_tables import expectation_table, group_table, savings_table
from benchmarks.measure import processor
from offboard.common.command_line import run_command
from offboard.common.errors import ConfigError, MissingExtra, OffloadError
from offboard.common.toml_file import unknown
from offboard.loadgen.play.machine import commit_here
from offboard.loadgen.play.part_setups import setups
from offboard.loadgen.scenario.outcome_files import read_lines
from offboard.loadgen.scenario.scenario import Scenario
from offboard.loadgen.scenario.scenario_file import find_scenario, read_scenario
from offboard.loadgen.testbed.local_testbed import COMMANDS, LocalTestbed
from offboard.loadgen.testbed.testbed import CLOUD, ROBOT, WAN, Setup

PROG = "python -m benchmarks.asking"
ROBOT_COMMAND = (sys.executable, "-m", "benchmarks.asking_robot")
OBSERVED = ("pose_graph", "arm")  # applications with a saving that is worth an estimate
RUN_S_MAX = 3600.0


def main(argv: Sequence[str]) -> int:
    return run_command(PROG, lambda: _run(argv))


def _run(argv: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(prog=PROG, description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"some of {', '.join(NAMES)} (default: all)")
    parser.add_argument("--calls", type=int, default=60, help="calls of each application on each site (60)")
    parser.add_argument(
        "--tasks", type=int, default=200, help="tasks of each application that observes (200)"
    )
    parser.add_argument(
        "--observed", default=",".join(OBSERVED), help="applications that observe (%(default)s)"
    )
    parser.add_argument("--seed", type=int, default=1, help="of inputs, link and deadlines (1)")
    parser.add_argument(
        "--out", type=Path, default=Path("out/asking"), help="folder of the runs (%(default)s)"
    )
    flags = parser.parse_args(argv)
    names, missing = present(flags.names or NAMES)
    observed, _ = present([one for one in flags.observed.split(",") if one])
    print(f"{processor()}, {os.cpu_count()} cores, Python {platform.python_version()}, ", end="")
    print(f"commit {commit_here() or 'unknown'}, seed {flags.seed}\n")

    def run(doing: str, tasks: int, chosen: Sequence[str]) -> dict[str, list[dict[str, Any]]]:
        return {name: play(name, doing, tasks=tasks, seed=flags.seed, out=flags.out) for name in chosen}

    asked, saved = run(ASK, flags.calls, names), run(OBSERVE, flags.tasks, observed)
    tables = [expectation_table(asked), group_table(asked)] if asked else []
    tables += [savings_table(saved)] if saved else []
    for table in tables:
        print(table)
    for why in missing:
        print(f"left out: {why}")
    return 0


def present(names: Sequence[str]) -> tuple[list[str], list[str]]:
    """The applications whose library is installed, and what the others need."""
    found, missing = [], []
    for name in dict.fromkeys(names):
        if name not in NAMES:
            raise ConfigError(unknown("application", name, NAMES))
        try:
            find_kind(name)
            found.append(name)
        except MissingExtra as error:
            missing.append(str(error))
    return found, missing


def play(name: str, doing: str, *, tasks: int, seed: int, out: Path) -> list[dict[str, Any]]:
    """The lines of one run, which is played unless it was played whole before."""
    scenario = read_scenario(find_scenario(f"{name.replace('_', '-')}-{CALM}")).changed(seed=seed)
    folder = out / f"{name}-{doing}-{seed}-{tasks}"
    lines, whole = folder / "lines.jsonl", folder / "whole"
    if not whole.exists():
        print(f"{doing} {name}: {tasks} tasks", file=sys.stderr, flush=True)
        folder.mkdir(parents=True, exist_ok=True)
        _play(scenario, name, doing, tasks=tasks, lines=lines)
        whole.touch()
    return list(read_lines(lines))


def _play(scenario: Scenario, name: str, doing: str, *, tasks: int, lines: Path) -> None:
    parts = setups(scenario, lines.parent, shown=False)
    flags = {
        "application": name,
        "lines": lines,
        "seed": scenario.seed,
        "tasks": tasks,
        "timeout": scenario.robot.timeout_s,
    }
    robot = Setup(flags, scenario.robot.cpus, command=doing)
    commands = {**COMMANDS, ROBOT: ROBOT_COMMAND}
    given = {CLOUD: parts[CLOUD], WAN: parts[WAN], ROBOT: robot}
    with LocalTestbed(lines.parent, given, commands=commands) as bed:
        bed.start()
        bed.start(ROBOT)
        if (code := bed.wait(ROBOT, RUN_S_MAX)) != 0:
            raise OffloadError(f"the robot ended with exit code {code}; see {lines.parent / 'logs'}")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
