"""`loadgen`: the bench's commands, each loaded when it is called."""

import os
import sys
from argparse import RawDescriptionHelpFormatter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from common.config import CommandParser, add_flags, check, resolve, run_command, setting

ENVIRONMENT = "LOADGEN"


def main(argv: Sequence[str] | None = None) -> int:
    arguments = list(sys.argv[1:] if argv is None else argv)
    listing = "\n".join(f"  {name:<8}{command.__doc__}" for name, command in COMMANDS.items())
    parser = CommandParser(
        prog="loadgen",
        usage="loadgen COMMAND ... (loadgen COMMAND --help says more)",
        description="The test bench of Offboard.\n\ncommands:\n" + listing,
        formatter_class=RawDescriptionHelpFormatter,
    )
    parser.add_argument("command", choices=tuple(COMMANDS), metavar="COMMAND", help="one of the above")
    command = parser.parse_args(arguments[:1]).command
    return run_command(f"loadgen {command}", lambda: COMMANDS[command](arguments[1:]))


@dataclass(frozen=True)
class RunConfig:
    """How a scenario is played."""

    out: Path = setting(Path("out/run"), "folder for the trace and logs", metavar="DIR")
    testbed: str = setting("local", "where it is played", choices=("local",))
    measure: str = setting(
        "scenario", "run every task on both sites, or as the scenario says", choices=("scenario", "both")
    )
    seed: int | None = setting(None, "instead of the scenario's own", minimum=0)
    tasks: int | None = setting(None, "instead of the scenario's own", minimum=1)

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
    from loadgen.play import play_demo

    return play_demo(config.out)


def _run(argv: Sequence[str]) -> int:
    """play a scenario and write its trace"""
    parser = CommandParser(prog="loadgen run", description=_run.__doc__)
    parser.add_argument("scenario", metavar="SCENARIO", help="TOML file, or the name of a shipped one: demo")
    add_flags(parser, RunConfig, ENVIRONMENT)
    flags = parser.parse_args(argv)
    config = resolve(RunConfig, flags, environ=os.environ, prefix=ENVIRONMENT)
    from loadgen.play import play
    from loadgen.scenario import find_scenario, read_scenario

    scenario = read_scenario(find_scenario(flags.scenario))
    scenario = scenario.changed(seed=config.seed, tasks=config.tasks, measure_all=config.measure == "both")
    return play(scenario, config.out)


def _table(argv: Sequence[str]) -> int:
    """the paper's Table II, and what it left out, from a trace or CSV"""
    from loadgen.evaluate import TableConfig, run_table

    parser = CommandParser(prog="loadgen table", description=_table.__doc__)
    parser.add_argument(
        "trace", type=Path, metavar="TRACE", help="trace.jsonl, or CSV size,onboard_s,cloud_s"
    )
    add_flags(parser, TableConfig, ENVIRONMENT)
    flags = parser.parse_args(argv)
    return run_table(flags.trace, resolve(TableConfig, flags, environ=os.environ, prefix=ENVIRONMENT))


def _wan(argv: Sequence[str]) -> int:
    """the relay between robot and cloud: delay, jitter, bandwidth, outage"""
    from loadgen.wan import WanConfig, run_wan

    parser = CommandParser(prog="loadgen wan", description=_wan.__doc__)
    add_flags(parser, WanConfig, "WAN")
    return run_wan(resolve(WanConfig, parser.parse_args(argv), environ=os.environ, prefix="WAN"))


COMMANDS: dict[str, Callable[[Sequence[str]], int]] = {
    "demo": _demo,
    "run": _run,
    "table": _table,
    "wan": _wan,
}

if __name__ == "__main__":
    sys.exit(main())
