"""`loadgen`: the commands of the test bench. Each one imports what it needs when it is called."""

import os
import signal
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from offboard.common.command_line import Command, CommandParser, add_flags, load, run_commands
from offboard.common.config import check, resolve, setting
from offboard.loadgen import rivals
from offboard.robot_client import policies

C = TypeVar("C")

PREFIX = "LOADGEN"
MEASURED = "trace.jsonl of a run, or a CSV file with the columns size,onboard_s,cloud_s"
SCENARIO, CHANGES = "scenario", "changes to the scenario"


def main(argv: Sequence[str] | None = None) -> int:
    about = "The test bench of Offboard: plays scenarios, compares policies, makes tables and reports."
    return run_commands("loadgen", about, COMMANDS, sys.argv[1:] if argv is None else argv)


@dataclass(frozen=True)
class RunConfig:
    """How a scenario is played."""

    out: Path = setting(Path("out/run"), "folder for all files of the run", group=SCENARIO, metavar="DIR")
    testbed: str = setting(
        "local",
        "where the parts run: local processes or docker containers",
        group=SCENARIO,
        choices=("local", "docker"),
    )
    watch: bool = setting(
        False, "show the run on a page while it goes on, and open it in a browser", group=SCENARIO
    )
    measure: str = setting(
        "scenario",
        "run each task as the scenario says, or on both sites",
        group=CHANGES,
        choices=("scenario", "both"),
    )
    seed: int | None = setting(None, "another seed", group=CHANGES, minimum=0)
    tasks: int | None = setting(None, "another number of tasks per robot", group=CHANGES, minimum=1)
    policy: str | None = setting(None, f"another policy: {policies.HELP}", group=CHANGES, metavar="NAME")
    predictor: str | None = setting(
        None, f"another predictor: {rivals.PREDICTOR_HELP}", group=CHANGES, metavar="NAME"
    )

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True)
class DemoConfig:
    """How the demo is played."""

    out: Path = setting(Path("out/demo"), "folder for the two runs", metavar="DIR")


def _demo(argv: Sequence[str]) -> int:
    config = _config("demo", DemoConfig, argv)
    from offboard.loadgen.play.demo import play_demo

    return play_demo(config.out)


def _run(argv: Sequence[str]) -> int:
    from offboard.loadgen.scenario.scenario_file import check_calls, find_scenario, known_names, read_scenario

    help = f"TOML file, or one of {', '.join(known_names())}"
    name, config = _operand_and_config("run", RunConfig, argv, operand="SCENARIO", help=help)
    from offboard.loadgen.play.play_scenario import play
    from offboard.loadgen.play.watch import Page

    _find_modules_here()
    path = find_scenario(name)
    scenario = read_scenario(path).changed(
        seed=config.seed,
        tasks=config.tasks,
        measure_all=config.measure == "both",
        policy=config.policy,
        predictor=config.predictor,
    )
    check_calls(scenario, path)
    page = Page.OPENED if config.watch else Page.NONE
    played = play(scenario, config.out, config.testbed, page=page)
    played.check_robots()
    played.check_verdicts()
    return 0


def _watch(argv: Sequence[str]) -> int:
    from offboard.loadgen.play.watch import WatchConfig, run_watch

    help = "folder of a run, which may still go on"
    return run_watch(*_operand_and_config("watch", WatchConfig, argv, operand="DIR", help=help, type=Path))


def _compare(argv: Sequence[str]) -> int:
    from offboard.loadgen.compare.compare import run_compare
    from offboard.loadgen.compare.compare_settings import CompareConfig

    return run_compare(*_scenarios_and_config("compare", CompareConfig, argv))


def _checks(argv: Sequence[str]) -> int:
    from offboard.loadgen.compare.compare_settings import RunsConfig
    from offboard.loadgen.compare.scenario_checks import run_checks

    return run_checks(*_scenarios_and_config("checks", RunsConfig, argv))


def _table(argv: Sequence[str]) -> int:
    from offboard.loadgen.table.table_settings import TableConfig
    from offboard.loadgen.table.table_two import run_table

    return run_table(*_file_and_config("table", TableConfig, argv))


def _claims(argv: Sequence[str]) -> int:
    from offboard.loadgen.claims.claim import ClaimsConfig
    from offboard.loadgen.claims.claims import run_claims

    _find_modules_here()
    return run_claims(
        *_operand_and_config(
            "claims", ClaimsConfig, argv, operand="DATASET", help=MEASURED, type=Path, several=True
        )
    )


def _replay(argv: Sequence[str]) -> int:
    from offboard.loadgen.replay.replay import run_replay
    from offboard.loadgen.replay.replay_settings import ReplayConfig

    return run_replay(*_file_and_config("replay", ReplayConfig, argv))


def _report(argv: Sequence[str]) -> int:
    from offboard.loadgen.report.report import ReportConfig, run_report

    _find_modules_here()
    help = "folder of a run, or a trace or CSV file; several folders or traces are compared"
    runs, config = _operand_and_config(
        "report", ReportConfig, argv, operand="DIR", help=help, type=Path, several=True
    )
    if len(runs) == 1:
        return run_report(runs[0], config)
    from offboard.loadgen.report.run_comparison import run_comparison

    return run_comparison(runs, config)


def _dataset(argv: Sequence[str]) -> int:
    from offboard.loadgen.play.measure_dataset import DatasetConfig, run_dataset

    help = "TOML file, or a shipped scenario: paper, congested, apriltags"
    name, config = _operand_and_config("dataset", DatasetConfig, argv, operand="SCENARIO", help=help)
    return run_dataset(name, config, ["loadgen", "dataset", *argv])


def _export(argv: Sequence[str]) -> int:
    from offboard.loadgen.export.export import ExportConfig, run_export

    help = "folder of a run, or its trace.jsonl; of further robots, trace-2.jsonl and so on"
    return run_export(*_operand_and_config("export", ExportConfig, argv, operand="RUN", help=help, type=Path))


def _fleet(argv: Sequence[str]) -> int:
    from offboard.loadgen.fleet.fleet import run_fleets
    from offboard.loadgen.fleet.fleet_settings import FleetConfig

    _find_modules_here()
    return run_fleets(_config("fleet", FleetConfig, argv))


def _robot(name: str, argv: Sequence[str]) -> int:
    from offboard.loadgen.robot.config import CallConfig, DriveConfig, RobotConfig

    cls: type[RobotConfig] = DriveConfig if name == "drive" else CallConfig
    config = load(
        cls, argv, prog=f"loadgen {name}", description=_about(name), environ=os.environ, prefix="ROBOT"
    )
    signal.signal(signal.SIGTERM, _interrupt)
    from offboard.loadgen.robot.command import run_robot  # after the flags: --help compiles nothing

    _find_modules_here()
    return run_robot(config)


def _interrupt(*_: object) -> NoReturn:
    raise KeyboardInterrupt


def _wan(argv: Sequence[str]) -> int:
    from offboard.loadgen.relay.wan import WanConfig, run_wan

    return run_wan(_config("wan", WanConfig, argv, prefix="WAN"))


def _about(name: str) -> str:
    about = COMMANDS[name].about
    return f"{about[0].upper()}{about[1:]}."


def _config(name: str, cls: type[C], argv: Sequence[str], prefix: str = PREFIX) -> C:
    """The settings of a command that has flags only."""
    parser = CommandParser(prog=f"loadgen {name}", description=_about(name))
    add_flags(parser, cls, prefix)
    return resolve(cls, parser.parse_args(argv), environ=os.environ, prefix=prefix)


def _operand_and_config(
    name: str,
    cls: type[C],
    argv: Sequence[str],
    *,
    operand: str,
    help: str,
    type: Callable[[str], Any] = str,
    several: bool = False,
) -> tuple[Any, C]:
    """The operand of a command, or its list of `several`, and its settings."""
    operands = f"{operand} ..." if several else operand
    parser = CommandParser(prog=f"loadgen {name}", description=_about(name), operands=operands)
    parser.add_argument("operand", type=type, metavar=operand, nargs="+" if several else None, help=help)
    add_flags(parser, cls, PREFIX)
    flags = parser.parse_args(argv)
    return flags.operand, resolve(cls, flags, environ=os.environ, prefix=PREFIX)


def _file_and_config(name: str, cls: type[C], argv: Sequence[str]) -> tuple[Path, C]:
    """The file and the settings of a command that reads one file of measured times."""
    _find_modules_here()
    return _operand_and_config(name, cls, argv, operand="TRACE", help=MEASURED, type=Path)


def _scenarios_and_config(name: str, cls: type[C], argv: Sequence[str]) -> tuple[list[str], C]:
    """The scenarios and the settings of a command that plays several of them."""
    from offboard.loadgen.scenario.scenario_file import known_names

    _find_modules_here()
    help = f"TOML files, or some of {', '.join(known_names())}"
    return _operand_and_config(name, cls, argv, operand="SCENARIO", help=help, several=True)


def _find_modules_here() -> None:
    """Let tasks, predictors and policies be in modules of the current folder, as `python -m` does."""
    sys.path.insert(0, str(Path.cwd()))


COMMANDS = {
    "demo": Command("plan on a real map through an outage, with Offboard and with the published rule", _demo),
    "run": Command("play a scenario, and judge its checks", _run),
    "watch": Command("show a run on a page, while it goes on or later, with a time slider", _watch),
    "compare": Command("play scenarios with several policies and seeds, and compare the policies", _compare),
    "checks": Command("play scenarios with several policies and seeds, and print every check", _checks),
    "table": Command("make Table II of the paper from a trace or CSV file", _table),
    "claims": Command("check each claim of the paper on traces or CSV files", _claims),
    "replay": Command("show what each policy would have done with the tasks of a trace or CSV file", _replay),
    "report": Command(
        "make an HTML page and PNG charts of a run, or a page that compares several runs", _report
    ),
    "fleet": Command(
        "simulate thousands of robots that share servers, with their real decision code", _fleet
    ),
    "dataset": Command(
        "measure the plans of a scenario on both sites, and write them as a CSV file", _dataset
    ),
    "export": Command("write a run as a CSV file, or as an MCAP file with messages of ROS 2", _export),
    "drive": Command(
        "drive a simulated robot on a map, and plan its paths onboard or in the cloud",
        partial(_robot, "drive"),
    ),
    "call": Command(
        "call a task of yours with numbers or inputs, one after the other or at a rate",
        partial(_robot, "call"),
    ),
    "wan": Command("relay between robot and cloud, with delay, jitter, loss, outages and other faults", _wan),
}

if __name__ == "__main__":
    sys.exit(main())
