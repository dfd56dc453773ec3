"""The tables in the Markdown that a command printed: found, joined, and cut to chosen rows and columns."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from offboard.common.errors import DataError
from offboard.loadgen.table.table_formats import UNDEFINED

BOUND = "bound"  # the column that says which end of an interval a line holds


@dataclass(frozen=True)
class MarkdownTable:
    """A table as cells."""

    headings: tuple[str, ...]
    rule: tuple[str, ...]  # the line below the headings, which aligns the columns
    rows: tuple[tuple[str, ...], ...]

    def lines(self) -> list[str]:
        return [f"| {' | '.join(cells)} |" for cells in (self.headings, self.rule, *self.rows)]

    def chosen(self, where: Mapping[str, Sequence[str]], shown: Sequence[str]) -> "MarkdownTable":
        """The rows whose cells are among those of `where`, and the columns `shown`, or all of them."""
        for heading in (*where, *shown):
            if (count := self.headings.count(heading)) != 1:
                many = "more than one" if count else "no"
                raise DataError(f"there is {many} column {heading!r} in {', '.join(self.headings)}")
        at = {heading: number for number, heading in enumerate(self.headings)}
        columns = [at[heading] for heading in shown] or [*range(len(self.headings))]
        rows = [row for row in self.rows if all(row[at[name]] in cells for name, cells in where.items())]
        return MarkdownTable(
            tuple(self.headings[one] for one in columns),
            tuple(self.rule[one] for one in columns),
            tuple(tuple(row[one] for one in columns) for row in rows),
        )

    def bracketed(self) -> "MarkdownTable":
        """With the ends of the intervals, which are lines of their own, in brackets behind the figures."""
        at = self.headings.index(BOUND)
        rows: list[list[str]] = []
        ends: list[list[tuple[str, ...]]] = []  # of each row
        for line in self.rows:
            if not line[at]:
                rows.append([*line])
                ends.append([])
            elif rows and line[:at] == tuple(rows[-1][:at]):
                ends[-1].append(line)
            else:
                raise DataError(f"bounds are not below their figures: {' | '.join(line)}")
        for row, bounds in zip(rows, ends, strict=True):
            if len(bounds) not in (0, 2):
                raise DataError(f"{len(bounds)} bounds instead of 2: {' | '.join(row)}")
            for number, cells in enumerate(zip(*bounds, strict=True)):
                if number != at and not {*cells} & {"", UNDEFINED} and {*cells} != {row[number]}:
                    row[number] += f" [{', '.join(cells)}]"
        table = MarkdownTable(self.headings, self.rule, tuple(map(tuple, rows)))
        return table.chosen({}, [one for one in self.headings if one != BOUND])

    def pivoted(self, column: str, cell: str) -> "MarkdownTable":
        """A row for each first cell, a column for each value of `column`, and in it the values of `cell`."""
        first, at, value = 0, self.headings.index(column), self.headings.index(cell)
        columns = list(dict.fromkeys(row[at] for row in self.rows))
        cells = {(row[first], row[at]): row[value] for row in self.rows}
        rows = tuple(
            (name, *(cells.get((name, one), UNDEFINED) for one in columns))
            for name in dict.fromkeys(row[first] for row in self.rows)
        )
        return MarkdownTable((self.headings[first], *columns), ("---", *("---:" for _ in columns)), rows)


def blocks_of(lines: Sequence[str]) -> Iterator[MarkdownTable | list[str]]:
    """The tables and the lines between them, in order."""
    block: list[str] = []
    in_table = False
    for line in lines:
        if line.startswith("|") != in_table and block:
            yield _table(block) if in_table else block
            block = []
        in_table = line.startswith("|")
        block.append(line)
    if block:
        yield _table(block) if in_table else block


def tables_of(lines: Sequence[str]) -> list[MarkdownTable]:
    return [one for one in blocks_of(lines) if isinstance(one, MarkdownTable)]


def first_table(lines: Sequence[str]) -> MarkdownTable:
    tables = tables_of(lines)
    if not tables:
        raise DataError("no table was printed")
    return tables[0]


def table_below(title: str, lines: Sequence[str]) -> MarkdownTable:
    """The first table below the heading with this text."""
    for number, line in enumerate(lines):
        if line.startswith("#") and line.lstrip("#").strip() == title:
            return first_table(lines[number:])
    raise DataError(f"there is no heading {title!r}")


def stacked(outputs: Sequence[Sequence[str]]) -> MarkdownTable:
    """The first tables of several outputs below each other; they must have the same columns."""
    first, *others = map(first_table, outputs)
    for other in others:
        if other.headings != first.headings:
            raise DataError(
                f"tables have other columns: {', '.join(first.headings)}; {', '.join(other.headings)}"
            )
    return MarkdownTable(
        first.headings, first.rule, tuple(row for one in (first, *others) for row in one.rows)
    )


def joined(heading: str, outputs: Mapping[str, Sequence[str]]) -> MarkdownTable:
    """The first tables of several outputs as one, with a first column that names the output.

    It has the columns that all of them have, because a command leaves out columns that do not fit.
    """
    first = {name: first_table(lines) for name, lines in outputs.items()}
    of_all = [set(table.headings) for table in first.values()]
    common = [one for one in next(iter(first.values())).headings if all(one in each for each in of_all)]
    chosen = {name: table.chosen({}, common) for name, table in first.items()}
    one = next(iter(chosen.values()))
    rows = tuple((name, *row) for name, table in chosen.items() for row in table.rows)
    return MarkdownTable((heading, *one.headings), ("---", *one.rule), rows)


def notes_of(outputs: Mapping[str, Sequence[str]]) -> list[str]:
    """The items of lists in several outputs: those that all share once, the others with their output."""
    notes = {name: _items(lines) for name, lines in outputs.items()}
    found = []
    for text in dict.fromkeys(text for each in notes.values() for text in each):
        names = [name for name, each in notes.items() if text in each]
        found.append(f"- {text}" if len(names) == len(notes) else f"- {', '.join(names)}: {text}")
    return found


def _items(lines: Sequence[str]) -> list[str]:
    found: list[str] = []
    for line in lines:
        if line.startswith("- "):
            found.append(line.removeprefix("- "))
        elif line.startswith("  ") and found:
            found[-1] += f" {line.strip()}"
    return found


def _table(lines: Sequence[str]) -> MarkdownTable:
    cells = [tuple(cell.strip() for cell in line.strip().strip("|").split("|")) for line in lines]
    if len(cells) < 2:
        raise DataError(f"not a table: {lines[0]}")
    rule = tuple("---:" if one.endswith(":") else "---" for one in cells[1])
    return MarkdownTable(cells[0], rule, tuple(cells[2:]))
