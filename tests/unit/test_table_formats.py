"""The four output formats of a table, each parsed back."""

import csv
import io
import json
import re
from dataclasses import asdict, fields, replace

import pytest

from offboard.loadgen.table.table_formats import FORMATS, Table, render
from offboard.loadgen.table.table_two_figures import HEADINGS, Score

SCORE = Score(
    "least-squares", "50", "", 0.302734, 0.70641, 0.14025, 0.14061, 0.00036, 0.17554, 0.18027, -0.00473,
    78.8, 950, 0.25, -2.7, 0.02, 0.03, 0.05, 0.06, 1.25, 12.5, 0.0131579, 55.5,
)  # fmt: skip
NO_FIGURES = Score("least-squares", "500", note="not enough rows")
SHOWN = {name: heading for name, heading in HEADINGS.items() if name not in ("predictor", "bound")}
COLUMNS = len(SHOWN)


def table_of(*scores: Score) -> Table:
    about = {"source": "my_trace 50%.jsonl", "rows": 1000, "left_out": 3, "feedback": "chosen"}
    return Table("my_trace 50%.jsonl: 1000 rows, feedback chosen.", about, SHOWN, scores, ("A note.",))


TABLE = table_of(SCORE, NO_FIGURES)


def cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_every_line_of_markdown_has_all_columns() -> None:
    """Markdown has caption, notes, headings and one line for each score, all with the same columns."""
    caption, note, blank, *lines = render([TABLE], "md").splitlines()
    assert (caption, note, blank) == ("my_trace 50%.jsonl: 1000 rows, feedback chosen.", "- A note.", "")
    assert [len(cells(line)) for line in lines] == [COLUMNS] * 4
    assert cells(lines[2])[:5] == ["50", "0.30273", "0.70641", "0.14025", "0.14061"]
    assert cells(lines[2])[8:11] == ["-0.00473", "78.80", "950"]
    assert cells(lines[3]) == ["500: not enough rows", *["–"] * 9, "0", *["–"] * 10]  # noqa: RUF001


def test_a_value_rounded_to_zero_has_no_sign() -> None:
    """A residual of -1e-9 is printed as 0.00000, not as -0.00000."""
    table = table_of(Score("least-squares", "5", cloud_residual_s=-1e-9))
    assert cells(render([table], "md").splitlines()[-1])[5] == "0.00000"


def test_csv_has_full_precision() -> None:
    """Every line names its table, numbers keep all digits, and undefined cells are empty."""
    first, second = csv.DictReader(io.StringIO(render([TABLE], "csv")))
    assert first["source"] == "my_trace 50%.jsonl"
    assert (first["rows"], first["left_out"]) == ("1000", "3")
    assert (first["feedback"], first["predictor"]) == ("chosen", "least-squares")
    for field in fields(Score):
        value = getattr(SCORE, field.name)
        assert first[field.name] == value if isinstance(value, str) else float(first[field.name]) == value
    assert (second["note"], second["r_cloud"]) == ("not enough rows", "")


def test_json_holds_the_whole_tables() -> None:
    """JSON holds all fields of the tables, with null for undefined figures."""
    parsed = json.loads(render([TABLE, TABLE], "json"))
    expected = {**TABLE.about, "notes": ["A note."], "scores": [asdict(SCORE), asdict(NO_FIGURES)]}
    assert parsed == {"tables": [expected, expected]}
    assert parsed["tables"][0]["scores"][1]["r_cloud"] is None


def test_latex_has_all_columns_and_escapes_text() -> None:
    """Every line of the tabular has all cells, and special characters of the file name are escaped."""
    text = render([TABLE], "latex")
    assert r"\caption{my\_trace 50\%.jsonl: 1000 rows" in text
    heading, *lines = [
        line.removesuffix(r" \\").split(" & ") for line in text.splitlines() if line.endswith(r"\\")
    ]
    columns = re.search(r"begin\{tabular\}\{(\w+)\}", text)
    assert columns is not None
    assert [len(columns[1]), len(heading), *map(len, lines)] == [COLUMNS] * 4
    assert lines[0][:2] == ["50", "0.30273"]
    assert lines[0][8] == "$-0.00473$"
    assert lines[1][:2] == ["500: not enough rows", "--"]
    assert text.count(r"\begin{") == text.count(r"\end{") == 2


@pytest.mark.parametrize("format", FORMATS)
def test_every_format_holds_every_table(format: str) -> None:
    """The output for two tables names the feedback modes of both."""
    full = replace(TABLE, caption="t, feedback full.", about=dict(TABLE.about) | {"feedback": "full"})
    text = render([TABLE, full], format)
    assert "chosen" in text
    assert "full" in text
