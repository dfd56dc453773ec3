"""Measures every figure of the docs that is not up to date, and writes the pages that show them.

A finished step is a file in docs/figures/, so Ctrl-C loses only the step under way: commit the files, and
call it again later or on another machine. A file is up to date if the code that its step runs was not changed
since then.
"""

import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from benchmarks.figures.code_of_step import commit_of
from benchmarks.figures.measured import Measured, alone, keep, measure, read_all, why_old
from benchmarks.figures.page import pages
from benchmarks.figures.step import ROOT, STEPS, Section, Unit, read_sections, units_of
from offboard.common.command_line import CommandParser, add_flags, run_command
from offboard.common.config import check, resolve, setting
from offboard.common.errors import ConfigError, OffloadError
from offboard.common.toml_file import unknown
from offboard.loadgen.play.machine import changed_code, commit_here
from offboard.loadgen.table.measured_rows import write_whole

PROG = "python -m benchmarks.figures"
MORE_FILES = 3  # changed files that a refusal names


@dataclass(frozen=True)
class FiguresConfig:
    """What is measured."""

    only: tuple[str, ...] = setting((), "measure these steps or parts only", metavar="NAME,NAME,..")
    again: tuple[str, ...] = setting((), "measure these even if up to date", metavar="NAME,NAME,..")
    list: bool = setting(False, "measure nothing: list the steps, their minutes and their state")
    write: bool = setting(False, "measure nothing: write the pages")

    def __post_init__(self) -> None:
        check(self)


def main(argv: Sequence[str]) -> int:
    return run_command(PROG, lambda: _run(argv))


def _run(argv: Sequence[str]) -> int:
    parser = CommandParser(prog=PROG, description=__doc__)
    add_flags(parser, FiguresConfig, "FIGURES")
    config = resolve(FiguresConfig, parser.parse_args(argv), environ=os.environ, prefix="FIGURES")
    os.chdir(ROOT)
    sections = read_sections(ROOT / STEPS)
    units = units_of(sections)
    chosen, again = _chosen(units, config.only, "only") or units, _chosen(units, config.again, "again")
    if config.write:
        write_pages(sections)
        return 0
    if outside := [unit.name for unit in again if unit not in chosen]:
        raise ConfigError(f"--again: {outside[0]} is not among those of --only")
    commit, changed = commit_here(), changed_code()
    if commit is None or changed is None:
        raise ConfigError("this is no checkout that git can read, so the commit of the figures is unknown")
    change = f"the code was changed: commit {', '.join(changed[:MORE_FILES])} first"
    if config.list:
        files = read_all(chosen)
        _print_states({unit: _why_old(unit, files.get(unit.name)) for unit in chosen}, files)
        if changed:
            print(change)
        return 0
    if changed:
        raise ConfigError(change)
    with alone():
        write_pages(sections)  # an error in a page is better known before than after hours
        return _measure(chosen, again, sections, commit)


def _measure(units: Sequence[Unit], again: Sequence[Unit], sections: Sequence[Section], commit: str) -> int:
    """Measure one after the other. A step that fails leaves its older file; the others go on."""
    failed = []
    for number, unit in enumerate(units, 1):
        why = _why_old(unit, read_all([unit]).get(unit.name))  # rows may be new since the last step
        if not why and unit not in again:
            continue
        about = f"{why or 'again'}, about {unit.step.minutes:g} minutes"
        _say(f"{number} of {len(units)}: {unit.name}, {about}")
        try:
            measured = measure(unit, _commit(unit), again=unit in again)
        except (OffloadError, OSError, subprocess.SubprocessError) as error:
            failed.append(f"{unit.name} is not measured: {error}")
            _say(failed[-1])
            continue
        if (now := commit_here()) != commit:
            raise OffloadError(f"the code is no longer that of commit {commit}, but {now}")
        try:
            keep(unit, measured)
            write_pages(sections)
        except (OffloadError, OSError) as error:
            failed.append(f"{unit.name} is measured, but not all is written: {error}")
            _say(failed[-1])
    if failed:
        _say("\n".join(["", *failed]))
    return 1 if failed else 0


def write_pages(sections: Sequence[Section]) -> None:
    """Write every page whose text is not as the files say."""
    for path, text in pages(ROOT, sections, read_all(units_of(sections))).items():
        if not (ROOT / path).is_file() or (ROOT / path).read_text() != text:
            write_whole(ROOT / path, text)
            _say(f"written: {path}")


def _chosen(units: Sequence[Unit], names: Sequence[str], flag: str) -> list[Unit]:
    """The steps or parts of these names; a step stands for all of its parts."""
    known = dict.fromkeys(name for unit in units for name in (unit.step.name, unit.name))
    for name in names:
        if name not in known:
            raise ConfigError(f"--{flag}: {unknown('step', name, tuple(known))}")
    return [unit for unit in units if unit.name in names or unit.step.name in names]


def _why_old(unit: Unit, measured: Measured | None) -> str:
    return why_old(unit, measured, _commit(unit))


def _commit(unit: Unit) -> str:
    return commit_of(unit.commands()) or "unknown"


def _print_states(states: dict[Unit, str], files: Mapping[str, Measured]) -> None:
    width = max(len(unit.name) for unit in states)
    for unit, why in states.items():
        needs = f"; needs {unit.step.needs}" if unit.step.needs else ""
        print(f"{unit.name:<{width}}  {unit.step.minutes:>5g} min  {why or 'up to date'}{needs}")
    left = sum(unit.step.minutes for unit, why in states.items() if why)
    took_s = sum(one.seconds for one in files.values())
    print(f"{len(states)} measurements; those that are not up to date take about {left:g} minutes")
    print(f"those that there are took {took_s / 3600:.1f} hours")


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
