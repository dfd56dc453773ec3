"""Measures the applications of examples/ and writes a table, all tasks as CSV and a picture for each of them.

`application_runs` plays the runs; a finished run of the same software and settings is not played again.
"""

import json
import os
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from benchmarks.application_runs import Planned, Progress, find_kind, planned, play
from benchmarks.application_tables import WORST, Run, faults, in_words, table, tasks_csv, worst_tasks
from benchmarks.measure import processor
from offboard.common.command_line import CommandParser, add_flags, run_command
from offboard.common.config import check, flag_of, resolve, setting, settings_of
from offboard.common.errors import ConfigError
from offboard.common.toml_file import unknown
from offboard.loadgen.compare.compare_settings import SEEDS_MAX
from offboard.loadgen.play.machine import commit_here
from offboard.loadgen.play.run_files import SUMMARY
from offboard.loadgen.table.measured_rows import write_whole

PROG = "python -m benchmarks.applications"
NAMES = ("apriltags", "registration", "signs", "pose_graph", "arm")
CALM = "calm"  # the scenario of the picture
SCENARIOS = (CALM, "outage", "bandwidth", "busy")


@dataclass(frozen=True)
class ApplicationsConfig:
    """What is measured, and where the results go."""

    seeds: int = setting(
        1,
        "number of runs of each scenario and policy; the seeds count up from the scenario's seed",
        minimum=1,
        maximum=SEEDS_MAX,
    )
    tasks: int | None = setting(None, "number of tasks (default: as in the scenario)", minimum=1)
    scenarios: tuple[str, ...] = setting(
        SCENARIOS, "scenarios of each application", choices=SCENARIOS, metavar="NAME,NAME,.."
    )
    out: Path = setting(
        Path("out/examples"), "folder for tables, pictures and the folders of the runs", metavar="DIR"
    )

    def __post_init__(self) -> None:
        check(self)


def main(argv: Sequence[str]) -> int:
    return run_command(PROG, lambda: _run(argv))


def _run(argv: Sequence[str]) -> int:
    parser = CommandParser(prog=PROG, description=__doc__, operands="[NAME ...]")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"some of {', '.join(NAMES)} (default: all)")
    add_flags(parser, ApplicationsConfig, "EXAMPLES")
    flags = parser.parse_args(argv)
    config = resolve(ApplicationsConfig, flags, environ=os.environ, prefix="EXAMPLES")
    names = tuple(dict.fromkeys(flags.names)) or NAMES
    for name in names:
        if name not in NAMES:
            raise ConfigError(unknown("application", name, NAMES))
    return measure(names, config)


def measure(names: Sequence[str], config: ApplicationsConfig) -> int:
    """Play and write every application; 1 if any answer is not verified."""
    tasks = {name: find_kind(name) for name in names}  # so that a missing library is named at once
    todo = {
        name: planned(name, config.scenarios, config.seeds, tasks=config.tasks, out=config.out)
        for name in names
    }
    progress, wrong = Progress(sum(map(len, todo.values()))), []
    for name, runs in todo.items():
        played = []
        for one in runs:
            progress.next(one)
            played.append(play(one, tasks[name]))
            progress.done(one)
        found = faults(played)
        write(name, played, notes(runs, found, command(names, config)), config.out)
        wrong += [text for texts in found.values() for text in texts]
    for text in wrong:
        print(text, file=sys.stderr)
    return 1 if wrong else 0


def write(name: str, runs: Sequence[Run], notes: str, out: Path) -> None:
    """Write the files of one application, and print its table and its worst tasks."""
    text = "\n".join([table(runs), *(f"- {line}" for line in in_words(runs)), "", notes])
    write_whole(out / f"{name}.md", text)
    write_whole(out / f"{name}-tasks.csv", tasks_csv(runs))
    first = min(run.seed for run in runs)
    calm = {run.policy: run for run in runs if run.seed == first and run.scenario.endswith(f"-{CALM}")}
    if calm:
        from benchmarks.application_pictures import picture

        write_whole(out / f"{name}.svg", picture(name, calm).decode())
    worst = [f"- {line}" for line in worst_tasks(runs)]
    heading = f"The {WORST} tasks in which `default` lost most against the faster constant policy:"
    print("\n".join([f"# {name}", "", text, heading, "", *worst, ""]), flush=True)


def notes(runs: Sequence[Planned], found: Mapping[str, Sequence[str]], command: str) -> str:
    """What is needed to judge and to repeat the table, and how many answers are not verified."""
    seeds = sorted({one.scenario.seed for one in runs})
    tasks = [one.scenario.workload.tasks for one in runs]
    began = sorted(
        datetime.fromisoformat(json.loads((one.out / SUMMARY).read_text())["started_at"]).date()
        for one in runs
    )
    days = " to ".join(dict.fromkeys(f"{day.day} {day:%B %Y}" for day in (began[0], began[-1])))
    spread = " to ".join(dict.fromkeys(str(seed) for seed in (seeds[0], seeds[-1])))
    commit = commit_here() or "unknown"
    counts = ", ".join(f"{len(texts)} {what}" for what, texts in found.items())
    lines = [
        f"Measured on {days} at commit {commit}, on {processor()} with {os.cpu_count()} cores.",
        f"Seed{'s' if len(seeds) > 1 else ''} {spread}, {max(tasks)} tasks in each run: `{command}`.",
        f"Of {sum(tasks):,} answers: {counts}.",
    ]
    if len(seeds) > 1:
        lines.append("In brackets: 95 % intervals, from blocks of neighbouring tasks.")
    return "\n".join(lines) + "\n"


def command(names: Sequence[str], config: ApplicationsConfig) -> str:
    """The command that measures the same, whether its settings came from flags or from the environment."""
    words = [*PROG.split(), *(() if tuple(names) == NAMES else names)]
    for one in settings_of(ApplicationsConfig):
        value = getattr(config, one.name)
        if value != one.default:
            words += [f"--{flag_of(one)}", ",".join(value) if isinstance(value, tuple) else str(value)]
    return shlex.join(words)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
