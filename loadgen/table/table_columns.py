"""Which columns of a table are printed: those that fit, those of --columns, or all of them.

How the columns are written is left to `table_formats`.
"""

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from offboard.common.config import setting
from offboard.common.errors import ConfigError
from offboard.common.toml_file import unknown
from offboard.loadgen.table.table_formats import FORMATS, MARKDOWN, Heading, Table, markdown_width, render

WIDTH = 100
GROUP = "columns of the table"


@dataclass(frozen=True, kw_only=True)
class FormatSettings:
    """How a command prints its tables."""

    format: str = setting(MARKDOWN, "format of the tables", choices=FORMATS)


@dataclass(frozen=True, kw_only=True)
class ColumnSettings(FormatSettings):
    """The columns that are printed; CSV and JSON always hold all of them."""

    columns: tuple[str, ...] = setting(
        (),
        f"columns to print, by their names in CSV and JSON (default: the most important that fit in {WIDTH} "
        "characters)",
        group=GROUP,
        metavar="NAME,NAME,..",
    )
    all_columns: bool = setting(
        False, "print all columns, however wide the table becomes", group=GROUP, name="all"
    )

    def check_columns(self, headings: Iterable[str]) -> None:
        """ConfigError if --columns is not about columns of `headings`, or not about Markdown or LaTeX."""
        if not self.columns:
            return
        if self.all_columns:
            raise ConfigError(f"--columns: {','.join(self.columns)} cannot be combined with --all")
        if self.format in ("csv", "json"):
            needed = f"needs --format md or latex: {self.format} holds all columns"
            raise ConfigError(f"--columns: {','.join(self.columns)} {needed}")
        known = tuple(headings)
        for name in self.columns:
            if name not in known:
                raise ConfigError(f"--columns: {unknown('column', name, known)}")

    def text(self, tables: Sequence[Table]) -> str:
        """The tables as they are printed."""
        if self.columns:
            tables = [_chosen(table, self.columns) for table in tables]
        if self.format == MARKDOWN:
            tables = [_wrapped(table if self.all_columns else _fitting(table)) for table in tables]
        return render(tables, self.format)


def _chosen(table: Table, names: Sequence[str]) -> Table:
    """The table with the columns `names`, and those of text, which say what a line is about.

    A table without any of these columns stays as it is: a comparison prints tables of two forms.
    """
    if not any(name in table.headings for name in names):
        return table
    return _with(table, {name for name, of in table.headings.items() if of.digits is None} | set(names))


def _fitting(table: Table) -> Table:
    """The table with the most important columns that fit, and a note that names the other ones."""
    table = _notes_outside(table)
    kept = {name for name, of in table.headings.items() if of.digits is None}
    for name in dict.fromkeys((*table.first, *table.headings)):
        if name in table.headings and markdown_width(_with(table, kept | {name})) <= WIDTH:
            kept.add(name)
    left_out = [name for name in table.headings if name not in kept]
    if not left_out:
        return table
    note = f"Not printed: {', '.join(left_out)}. --columns NAME,.. chooses columns; --all prints all."
    return replace(_with(table, kept), notes=(*table.notes, note))


def _with(table: Table, names: set[str]) -> Table:
    headings: Mapping[str, Heading] = {name: of for name, of in table.headings.items() if name in names}
    return replace(table, headings=headings)


def _notes_outside(table: Table) -> Table:
    """The notes of lines among those of the table: in a cell, they would take the room of all columns."""
    first = next(iter(table.headings))
    notes = [f"{getattr(line, first)}: {line.note}" for line in table.lines if line.note]
    lines = [replace(line, note="") for line in table.lines]
    return replace(table, lines=lines, notes=(*table.notes, *dict.fromkeys(notes)))


def _wrapped(table: Table) -> Table:
    notes = tuple(map(_filled_note, table.notes))
    return replace(table, caption=_filled(table.caption), notes=notes, ending=_filled_note(table.ending))


def _filled_note(text: str) -> str:
    """A note, with room for the dash of its list."""
    return _filled(text, "  ").lstrip()


def _filled(text: str, indent: str = "") -> str:
    """The text in lines of at most WIDTH characters, without breaking words."""
    return textwrap.fill(
        text,
        WIDTH,
        initial_indent=indent,
        subsequent_indent=indent,
        break_long_words=False,
        break_on_hyphens=False,
    )
