"""The output formats of tables: Markdown, CSV, JSON and LaTeX.

The modules that make a table compute its figures.
"""

import csv
import io
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from typing import Any

MARKDOWN = "md"
UNDEFINED = "–"  # noqa: RUF001 (the dash for "no value" in tables)
MARKDOWN_RULE_MIN = 3  # dashes under a heading


@dataclass(frozen=True, slots=True)
class Heading:
    """The heading of a column, and the digits after the point in its cells; None: the cells are text."""

    markdown: str
    latex: str
    digits: int | None


@dataclass(frozen=True, slots=True)
class Table:
    """A table: lines, which are dataclasses of one type, and their headings.

    `headings` are the columns of Markdown and LaTeX, in order. CSV and JSON hold all fields of the lines.
    `about` comes before the cells of each CSV line, and with the lines in JSON.
    The `note` of a line is shown in its first column. None in a line means undefined.
    `first` names the most important columns: they are printed if there is no room for all.
    `ending` is a sentence below the table; CSV has no room for it.
    """

    caption: str
    about: Mapping[str, Any]
    headings: Mapping[str, Heading]
    lines: Sequence[Any]
    notes: tuple[str, ...] = ()
    first: tuple[str, ...] = ()
    ending: str = ""


def column(heading: str, digits: int | None = None, *, latex: str | None = None, default: Any = None) -> Any:
    """One field of a line, with its heading. Without `latex`, LaTeX has the same heading as Markdown."""
    shown = Heading(heading, _latex_text(heading) if latex is None else latex, digits)
    return field(default=default, metadata={"heading": shown})


def headings_of(line: type) -> dict[str, Heading]:
    """The headings of the fields that `column` made, in their order."""
    return {one.name: one.metadata["heading"] for one in fields(line) if one.metadata}


def render(tables: Sequence[Table], format: str) -> str:
    """All tables as text, in one of `FORMATS`."""
    return _RENDERERS[format](tables)


def cells(table: Table, line: Any) -> list[str]:
    """The cells of one line, as Markdown shows them."""
    return [_cell(table, line, name) for name in table.headings]


def markdown_width(table: Table) -> int:
    """The number of characters in each line of the Markdown table."""
    return sum(_widths(_markdown_cells(table))) + 3 * len(table.headings) + 1


def _markdown(tables: Sequence[Table]) -> str:
    """Aligned, so that people can read it as it is: text to the left, numbers to the right."""
    blocks = []
    for table in tables:
        texts = _markdown_cells(table)
        widths, numbers = _widths(texts), [of.digits is not None for of in table.headings.values()]
        rule = ["-" * (width - number) + ":" * number for width, number in zip(widths, numbers, strict=True)]
        lines = [_markdown_line(line, widths, numbers) for line in (texts[0], rule, *texts[1:])]
        notes = [f"- {note}" for note in table.notes]
        ending = ["", f"- {table.ending}"] if table.ending else []
        blocks.append("\n".join([table.caption, *notes, "", *lines, *ending, ""]))
    return "\n".join(blocks)


def _markdown_line(texts: Sequence[str], widths: Sequence[int], numbers: Sequence[bool]) -> str:
    columns = zip(texts, widths, numbers, strict=True)
    padded = (text.rjust(width) if number else text.ljust(width) for text, width, number in columns)
    return f"| {' | '.join(padded)} |"


def _markdown_cells(table: Table) -> list[list[str]]:
    return [[of.markdown for of in table.headings.values()], *(cells(table, line) for line in table.lines)]


def _widths(texts: Sequence[Sequence[str]]) -> list[int]:
    return [max(MARKDOWN_RULE_MIN, *map(len, column)) for column in zip(*texts, strict=True)]


def _csv(tables: Sequence[Table]) -> str:
    """Numbers have full precision, every line names its table, and an undefined cell is empty."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*tables[0].about, *(field.name for field in fields(tables[0].lines[0]))])
    for table in tables:
        for line in table.lines:
            values = ["" if value is None else value for value in asdict(line).values()]
            writer.writerow([*table.about.values(), *values])
    return text.getvalue()


def _json(tables: Sequence[Table]) -> str:
    plain = [
        {
            **table.about,
            "notes": table.notes,
            "scores": [asdict(line) for line in table.lines],
            **({"ending": table.ending} if table.ending else {}),
        }
        for table in tables
    ]
    return json.dumps({"tables": plain}, indent=2, ensure_ascii=False) + "\n"


def _latex(tables: Sequence[Table]) -> str:
    blocks = []
    for table in tables:
        heading = " & ".join(heading.latex for heading in table.headings.values()) + r" \\"
        lines = [
            " & ".join(_latex_cell(cell) for cell in cells(table, line)) + r" \\" for line in table.lines
        ]
        caption = _latex_text(" ".join([table.caption, *table.notes, table.ending]).rstrip())
        top = [r"\begin{table*}", rf"\caption{{{caption}}}"]
        body = [r"\begin{tabular}{l" + "r" * (len(table.headings) - 1) + "}", r"\hline", heading, r"\hline"]
        blocks.append("\n".join([*top, *body, *lines, r"\hline", r"\end{tabular}", r"\end{table*}", ""]))
    return "\n".join(blocks)


def _cell(table: Table, line: Any, name: str) -> str:
    value, digits = getattr(line, name), table.headings[name].digits
    if digits is None:
        first = name == next(iter(table.headings))
        return f"{value}: {line.note}" if first and line.note else str(value)
    return UNDEFINED if value is None else f"{round(float(value), digits) + 0.0:.{digits}f}"  # no -0.00000


def _latex_cell(cell: str) -> str:
    if cell == UNDEFINED:
        return "--"
    words = cell.split(" ")  # such as those of an interval
    return " ".join(f"${word}$" if word[:1] == "-" and word[1:] else _latex_text(word) for word in words)


def _latex_text(text: str) -> str:
    special = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    special |= {"<": "$<$", ">": "$>$"}
    return "".join(special.get(sign, f"\\{sign}" if sign in "&%$#_{}" else sign) for sign in text)


_RENDERERS: dict[str, Callable[[Sequence[Table]], str]] = {
    MARKDOWN: _markdown,
    "csv": _csv,
    "json": _json,
    "latex": _latex,
}
FORMATS = tuple(_RENDERERS)
