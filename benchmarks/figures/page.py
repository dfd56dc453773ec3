"""The pages: those of docs/figures, and the marked blocks of other pages, from the files of the steps.

A block is a line `<!-- figure: NAME | table: TITLE | COLUMN: CELL, .. | show: COLUMN, .. -->` and a line
`<!-- end -->`. What is between them comes from the first table of the step, or of its part with NAME/PART,
or from the table below the heading TITLE; only rows with these cells are shown.
"""

import os.path
import re
import textwrap
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from benchmarks.figures.markdown_tables import (
    MarkdownTable,
    blocks_of,
    joined,
    notes_of,
    stacked,
    table_below,
)
from benchmarks.figures.measured import OTHER_FILES, Measured, of_other_files
from benchmarks.figures.step import FOLDER, Section, Step, Unit, units_of
from offboard.common.errors import DataError
from offboard.loadgen.table.table_columns import WIDTH

OVERVIEW = FOLDER / "README.md"  # git hosts show it with the folder
BLOCK = re.compile(r"<!-- figure: (?P<what>[^\n]*?) -->\n(?P<shown>.*?)<!-- end -->", re.DOTALL)
SHOW, TABLE = "show", "table"
DAY = len("2026-11-26")  # characters of a date that are the day
WRITTEN = (
    "<!-- `make figures` writes this page from docs/figures/. Change docs/figures/steps.toml instead. -->"
)
ABOUT = """\
# All figures

[Results](../results.md) shows the figures that matter most. The pages of this folder hold all of them.
`make figures` measures them, and writes these pages from what the commands printed
([how](../performance.md#all-figures-of-the-docs)).
Each table names its commit, date, machine and commands. Later commits may give other figures, also because
a scenario was changed: `git log -1 -- loadgen/scenarios/NAME.toml` shows when.
"""
BACK = "[All figures](README.md) lists the other pages, and says which figures are of an older commit."
NOT_YET = "Not measured yet."


def pages(root: Path, sections: Sequence[Section], files: Mapping[str, Measured]) -> dict[Path, str]:
    """Every page that holds figures, as it should be, by its path from the root."""
    found = {OVERVIEW: overview(sections, files)}
    found |= {section.path: section_page(section, files) for section in sections}
    steps = {step.name: step for section in sections for step in section.steps}
    places = {step.name: section.path for section in sections for step in section.steps}
    for path in [*sorted((root / "docs").glob("*.md")), root / "README.md"]:
        name, text = path.relative_to(root), path.read_text()
        if BLOCK.search(text):
            found[name] = filled(text, name, steps, files, places)
    return found


def overview(sections: Sequence[Section], files: Mapping[str, Measured]) -> str:
    """The page that lists all pages of figures, and what is of which commit."""
    lines = [WRITTEN, "", *ABOUT.splitlines(), "", "| page | holds |", "| --- | --- |"]
    for section in sections:
        steps = ", ".join(_link(step.title, section) for step in section.steps)
        lines.append(f"| [{section.title}]({section.path.name}) | {steps} |")
    return "\n".join([*lines, "", "## State", "", *_commits(sections, files)]) + "\n"


def section_page(section: Section, files: Mapping[str, Measured]) -> str:
    """The page of a section."""
    lines = [
        WRITTEN,
        "",
        f"# {section.title}",
        "",
        *section.about.splitlines(),
        *([""] if section.about else []),
    ]
    lines.append(BACK)
    for step in section.steps:
        lines += ["", f"## {step.title}", "", *_section(step, files)]
    return "\n".join(lines) + "\n"


def filled(
    text: str,
    page: Path,
    steps: Mapping[str, Step],
    files: Mapping[str, Measured],
    places: Mapping[str, Path],
) -> str:
    """The page with its blocks as they should be; `places` has the page of each step."""

    def block(found: "re.Match[str]") -> str:
        shown = "\n".join(_block(found["what"], page, steps, files, places))
        return f"<!-- figure: {found['what']} -->\n\n{shown}\n\n<!-- end -->"

    return BLOCK.sub(block, text)


def _block(
    what: str,
    page: Path,
    steps: Mapping[str, Step],
    files: Mapping[str, Measured],
    places: Mapping[str, Path],
) -> list[str]:
    name, *filters = (one.strip() for one in what.split("|"))
    where = {key.strip(): cells for key, cells in map(_filter, filters)}
    shown, titles = where.pop(SHOW, ()), where.pop(TABLE, ())
    name, _, part = name.partition("/")
    if name not in steps or (part and part not in steps[name].parts):
        raise DataError(f"{page}: <!-- figure: {what} -->: there is no such step")
    step = steps[name]
    there = {unit: one for unit, one in _there(step, files).items() if part in ("", unit.part)}
    link = f"{os.path.relpath(places[name], page.parent)}#{_anchor(step.title)}"
    if not there:
        return [f"{NOT_YET} [How it is measured]({link})."]
    conditions = [f"{line} [All figures]({link})." for line in _conditions(there)]
    some = there if part or not step.parts else {}  # a table of several parts stands alone
    pictures = [line for unit in some for line in _pictures(unit, page.parent)]
    try:
        table = _table(step, there, ", ".join(titles)).chosen(where, shown)
        return [*pictures, *table.lines(), "", *conditions]
    except DataError as error:
        raise DataError(f"{page}: <!-- figure: {what} -->: {error}") from None


def _filter(text: str) -> tuple[str, list[str]]:
    key, _, cells = text.partition(":")
    return key, [cell.strip() for cell in cells.split(",")]


def _table(step: Step, there: Mapping[Unit, Measured], title: str) -> MarkdownTable:
    """The table that other pages may show: the one below this heading, or the first one of each part."""
    if step.merge:
        return _merged(step, there)
    outputs = [one.output for one in there.values()]
    return table_below(title, outputs[0]) if title else stacked(outputs)


def _merged(step: Step, there: Mapping[Unit, Measured]) -> MarkdownTable:
    """The tables of all parts as one."""
    table = joined(step.merge, {unit.part: one.output for unit, one in there.items()})
    table = table.bracketed() if step.brackets else table
    return table.pivoted(*step.pivot) if step.pivot else table


def _there(step: Step, files: Mapping[str, Measured]) -> dict[Unit, Measured]:
    return {unit: files[unit.name] for unit in step.units() if unit.name in files}


def _commits(sections: Sequence[Section], files: Mapping[str, Measured]) -> Iterator[str]:
    """Which commit the figures are of, which ones are of another commit, and which ones are missing."""
    units = units_of(sections)
    of = {step.name: section for section in sections for step in section.steps}
    there = [(unit, files[unit.name]) for unit in units if unit.name in files]
    if not there:
        yield "Nothing is measured yet."
        return
    commit = max((one for _, one in there), key=lambda one: one.date).commit
    same, others = [], dict[str, list[Unit]]()
    for unit, one in there:
        if of_other_files(unit, one):
            others.setdefault(OTHER_FILES, []).append(unit)
        elif one.commit != commit:
            others.setdefault(f"of commit {one.commit}", []).append(unit)
        else:
            same.append(one)
    done = f"**{len(there)} of {len(units)} measurements are done**"
    dates = f" ({_span(same)})" if same else ""
    yield f"{done}, and {len(same)} of them are of commit {commit}{dates}."
    missing = [unit for unit in units if unit.name not in files]
    for why, some in (*others.items(), ("not measured yet", missing)):
        if some:
            yield from ("", f"{why[0].upper()}{why[1:]}:", "", *(f"- {one}" for one in _named(some, of)))


def _named(units: Sequence[Unit], of: Mapping[str, Section]) -> Iterator[str]:
    """The sections of these measurements, with their parts if not all of them are meant."""
    for step in dict.fromkeys(unit.step.name for unit in units):
        some = [unit for unit in units if unit.step.name == step]
        one = some[0].step
        parts = "" if len(some) == len(list(one.units())) else f" ({', '.join(unit.part for unit in some)})"
        yield f"{_link(one.title, of[step])}{parts}"


def _section(step: Step, files: Mapping[str, Measured]) -> Iterator[str]:
    there = _there(step, files)
    yield step.about
    yield from ("", "```sh", *_commands(step), "```", "")
    if not there:
        yield NOT_YET
        return
    yield from _conditions(there)
    if missing := [unit.part for unit in step.units() if unit not in there]:
        yield from ("", f"Not measured yet: {', '.join(missing)}.")
    if step.merge:
        notes = notes_of({unit.part: one.output for unit, one in there.items()})
        yield from ("", *_merged(step, there).lines(), *(["", *notes] if notes else []))
        return
    for unit, one in there.items():
        if unit.part:
            yield from ("", f"### {unit.step.title}: {unit.part}")
        yield from ("", *_pictures(unit, FOLDER), *_output(step, one))


def _pictures(unit: Unit, folder: Path) -> Iterator[str]:
    for path in unit.copies().values():
        yield from (f"![{unit.step.title}: {unit.part or unit.name}]({os.path.relpath(path, folder)})", "")


def _commands(step: Step) -> Iterator[str]:
    for command in Unit(step, "NAME" if step.parts else "").commands():
        yield " \\\n  ".join(_wrapped(command, WIDTH - 4))
    if step.parts:
        yield from (f"# {line}" for line in _wrapped(f"NAME: {', '.join(step.parts)}", WIDTH - 2))


def _wrapped(text: str, width: int) -> list[str]:
    return textwrap.wrap(text, width, break_long_words=False, break_on_hyphens=False)


def _output(step: Step, one: Measured) -> Iterator[str]:
    """What was printed, with headings below that of the step."""
    if step.plain:
        yield from ("```", *one.output, "```")
        return
    for block in blocks_of(one.output):
        if isinstance(block, MarkdownTable):
            yield from block.lines()
            if step.first_table:
                return
        else:
            yield from (re.sub(r"^#+ (.*)", r"**\1**", line) for line in block)


def _conditions(there: Mapping[Unit, Measured]) -> Iterator[str]:
    """Commit, date, machine, rows and stolen time: one line for each different one."""
    lines: dict[str, list[Measured]] = {}
    for one in there.values():
        lines.setdefault(_where(one), []).append(one)
    names = {id(one): unit.part for unit, one in there.items()}
    for where, some in lines.items():
        parts = "" if len(lines) == 1 else f"- {', '.join(names[id(one)] for one in some)}: "
        stolen = [one.stolen_percent for one in some if one.stolen_percent is not None]
        worst = (
            f" The host of this virtual machine gave at most {max(stolen):g} % of its CPU time to others."
            if stolen
            else ""
        )
        yield f"{parts}Commit {where.format(_span(some))}{worst}"


def _where(one: Measured) -> str:
    of = one.machine
    rows = [
        f"rows of {Path(name).name} of commit {about['commit']}"
        for name, about in one.reads.items()
        if "commit" in about
    ]
    return (
        f"{one.commit}, {{}}; {of['cpu']}, {of['cores']} cores, {of['memory_gib']} GiB, "
        f"{of['kernel']}, Python {of['python']}{''.join(f'; {each}' for each in rows)}."
    )


def _span(some: Sequence[Measured]) -> str:
    dates = sorted(one.date[:DAY] for one in some)
    return dates[0] if dates[0] == dates[-1] else f"{dates[0]} to {dates[-1]}"


def _link(title: str, section: Section) -> str:
    return f"[{title}]({section.path.name}#{_anchor(title)})"


def _anchor(title: str) -> str:
    """The anchor of a heading, as GitHub makes it."""
    return re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")


def doubled_titles(sections: Sequence[Section]) -> list[str]:
    """Titles that would have the same anchor."""
    titles = Counter(
        _anchor(title)
        for section in sections
        for title in (section.title, *(step.title for step in section.steps))
    )
    return [title for title, count in titles.items() if count > 1]
