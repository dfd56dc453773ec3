"""`loadgen`: the bench's commands, each loaded when it is called."""

import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from offboard.common.config import CommandParser, RawHelp, add_flags, check, resolve, run_command, setting
from offboard.robot_client import policies, predictors

C = TypeVar("C")

ENVIRONMENT = "LOADGEN"


def main(argv: Sequence[str] | None = None) -> int:
    arguments = list(sys.argv[1:] if argv is None else argv)
    listing = "\n".join(f"  {name:<9}{command.__doc__}" for name, command in COMMANDS.items())
    parser = CommandParser(
        prog="loadgen",
        usage="loadgen COMMAND ... (loadgen COMMAND --help says more)",
        description="The test bench of Offboard.\n\ncommands:\n" + listing,
        formatter_class=RawHelp,
    )
    parser.add_argument("command", choices=tuple(COMMANDS), metavar="COMMAND", help="one of the above")
    command = parser.parse_args(arguments[:1]).command
    return run_command(f"loadgen {command}", lambda: COMMANDS[command](arguments[1:]))


@dataclass(frozen=True)
class RunConfig:
    """How a scenario is played."""

    out: Path = setting(Path("out/run"), "folder for all that the run writes", metavar="DIR")
    testbed: str = setting(
        "local", "where it is played: processes, or containers", choices=("local", "docker")
    )
    measure: str = setting(
        "scenario", "run every task on both sites, or as the scenario says", choices=("scenario", "both")
    )
    seed: int | None = setting(None, "instead of the scenario's own", minimum=0)
    tasks: int | None = setting(None, "instead of the scenario's own", minimum=1)
    policy: str | None = setting(None, f"instead of the scenario's own: {policies.HELP}", metavar="NAME")
    predictor: str | None = setting(
        None, f"instead of the scenario's or the policy's own: {predictors.HELP}", metavar="NAME"
    )

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True)
class DemoConfig:
    """How the demo is played."""

    out: Path = setting(Path("out/demo"), "folder for trace.jsonl, table.md and logs", metavar="DIR")


def _demo(argv: Sequence[str]) -> int:
    """350 plans on a real map, three processes on loopback, and the paper's table"""
    parser = CommandParser(prog="loadgen demo", description=_demo.__doc__)
    add_flags(parser, DemoConfig, ENVIRONMENT)
    config = resolve(DemoConfig, parser.parse_args(argv), environ=os.environ, prefix=ENVIRONMENT)
    from offboard.loadgen.play.play_scenario import play_demo

    return play_demo(config.out)


def _run(argv: Sequence[str]) -> int:
    """play a scenario: its trace, the truth about its link, its events and the verdict of its checks"""
    from offboard.loadgen.scenario.scenario_file import find_scenario, read_scenario, shipped

    parser = CommandParser(prog="loadgen run", description=_run.__doc__)
    help = f"TOML file, or a shipped one: {', '.join(shipped())}"
    parser.add_argument("scenario", metavar="SCENARIO", help=help)
    add_flags(parser, RunConfig, ENVIRONMENT)
    flags = parser.parse_args(argv)
    config = resolve(RunConfig, flags, environ=os.environ, prefix=ENVIRONMENT)
    from offboard.loadgen.play.play_scenario import play

    _find_modules_here()
    scenario = read_scenario(find_scenario(flags.scenario)).changed(
        seed=config.seed,
        tasks=config.tasks,
        measure_all=config.measure == "both",
        policy=config.policy,
        predictor=config.predictor,
    )
    played = play(scenario, config.out, config.testbed)
    played.check_robots()
    played.check_verdicts()
    return 0


def _compare(argv: Sequence[str]) -> int:
    """play scenarios once per policy and seed, in turn, and compare the policies with intervals"""
    from offboard.loadgen.compare.compare import run_compare
    from offboard.loadgen.compare.compare_settings import CompareConfig
    from offboard.loadgen.scenario.scenario_file import shipped

    parser = CommandParser(prog="loadgen compare", description=_compare.__doc__)
    help = f"TOML files, or shipped ones: {', '.join(shipped())}"
    parser.add_argument("scenarios", metavar="SCENARIO", nargs="+", help=help)
    add_flags(parser, CompareConfig, ENVIRONMENT)
    flags = parser.parse_args(argv)
    _find_modules_here()
    return run_compare(flags.scenarios, resolve(CompareConfig, flags, environ=os.environ, prefix=ENVIRONMENT))


def _table(argv: Sequence[str]) -> int:
    """the paper's Table II, and what it left out, from a trace or CSV"""
    from offboard.loadgen.table.table_settings import TableConfig
    from offboard.loadgen.table.table_two import run_table

    return run_table(*_file_and_config("table", _table.__doc__, TableConfig, argv))


def _replay(argv: Sequence[str]) -> int:
    """what each policy would have made of the tasks of a trace or CSV"""
    from offboard.loadgen.table.replay import ReplayConfig, run_replay

    return run_replay(*_file_and_config("replay", _replay.__doc__, ReplayConfig, argv))


def _report(argv: Sequence[str]) -> int:
    """a run as one HTML page of charts and tables, and the charts as PNGs"""
    from offboard.loadgen.report.report import ReportConfig, run_report

    parser = CommandParser(prog="loadgen report", description=_report.__doc__)
    parser.add_argument("run", type=Path, metavar="DIR", help="a run's folder; or a trace or CSV file")
    add_flags(parser, ReportConfig, ENVIRONMENT)
    flags = parser.parse_args(argv)
    return run_report(flags.run, resolve(ReportConfig, flags, environ=os.environ, prefix=ENVIRONMENT))


def _dataset(argv: Sequence[str]) -> int:
    """measure a scenario's plans on both sites: NAME.csv, and how it was measured"""
    from offboard.loadgen.play.measure_dataset import DatasetConfig, run_dataset

    parser = CommandParser(prog="loadgen dataset", description=_dataset.__doc__)
    parser.add_argument("scenario", metavar="SCENARIO", help="TOML file, or a shipped one: paper, congested")
    add_flags(parser, DatasetConfig, ENVIRONMENT)
    flags = parser.parse_args(argv)
    config = resolve(DatasetConfig, flags, environ=os.environ, prefix=ENVIRONMENT)
    return run_dataset(flags.scenario, config, ["loadgen", "dataset", *argv])


def _export(argv: Sequence[str]) -> int:
    """the tasks of a trace that ran on both sites, as a CSV dataset"""
    from offboard.loadgen.table.export_dataset import ExportConfig, run_export

    return run_export(*_file_and_config("export", _export.__doc__, ExportConfig, argv))


def _file_and_config(name: str, about: str | None, cls: type[C], argv: Sequence[str]) -> tuple[Path, C]:
    """The arguments of a command that reads one file of measured times."""
    parser = CommandParser(prog=f"loadgen {name}", description=about)
    parser.add_argument(
        "trace", type=Path, metavar="TRACE", help="trace.jsonl, or CSV size,onboard_s,cloud_s"
    )
    add_flags(parser, cls, ENVIRONMENT)
    flags = parser.parse_args(argv)
    return flags.trace, resolve(cls, flags, environ=os.environ, prefix=ENVIRONMENT)


def _find_modules_here() -> None:
    """As `python -m` does, so that a scenario's task may be a module of the user's."""
    sys.path.insert(0, str(Path.cwd()))


def _wan(argv: Sequence[str]) -> int:
    """the relay between robot and cloud: delay, jitter, loss, bandwidth, outage and other faults"""
    from offboard.loadgen.relay.wan import WanConfig, run_wan

    parser = CommandParser(prog="loadgen wan", description=_wan.__doc__)
    add_flags(parser, WanConfig, "WAN")
    return run_wan(resolve(WanConfig, parser.parse_args(argv), environ=os.environ, prefix="WAN"))


COMMANDS: dict[str, Callable[[Sequence[str]], int]] = {
    "demo": _demo,
    "run": _run,
    "compare": _compare,
    "table": _table,
    "replay": _replay,
    "report": _report,
    "dataset": _dataset,
    "export": _export,
    "wan": _wan,
}

if __name__ == "__main__":
    sys.exit(main())
