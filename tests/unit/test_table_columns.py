"""Which columns of a table are printed."""

import json
from pathlib import Path

import pytest

from offboard.loadgen.__main__ import main
from offboard.loadgen.compare.comparison_line import FIRST, HEADINGS, Line
from offboard.loadgen.table.table_columns import WIDTH, ColumnSettings
from offboard.loadgen.table.table_formats import Table
from tests.table_loops import THOUSAND, csv_of, lines_of

LINES = [
    Line("paper", tasks=200, lost=0, mean_ms=1234.5, over_constant=1.0, p95_ms=4321.0, note="no outage"),
    Line("hedge:probe:greedy@k-means", tasks=200, lost=0, mean_ms=234.5, over_constant=0.2, p95_ms=321.0),
]
TABLE = Table("About two policies. " * 9, {"scenario": "calm"}, HEADINGS, LINES, ("A note. " * 30,), FIRST)


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    path = tmp_path / "d.csv"
    path.write_text(csv_of(THOUSAND[:200]))
    return path


@pytest.mark.parametrize(
    "command",
    [
        ["table", "d.csv"],
        ["table", "d.csv", "--predictors", "least-squares,parts", "--bootstrap", "--windows", "20,999"],
        ["replay", "d.csv"],
        ["compare", "nonlinear", "heavy-tail", "--simulate", "--tasks", "60", "--seeds", "1", "--jobs", "1"],
    ],
)
def test_a_printed_table_is_at_most_100_characters_wide(
    command: list[str], dataset: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """No line is longer, and the columns that are left out are named with the flags that print them."""
    monkeypatch.chdir(dataset.parent)
    assert main(command) == 0
    out = capsys.readouterr().out
    assert max(map(len, out.splitlines())) <= WIDTH
    assert "Not printed: " in out
    assert "--all" in out


def test_the_most_important_columns_are_kept() -> None:
    """Columns of text stay, then columns in the order of `first` as long as there is room."""
    printed = ColumnSettings().text([TABLE])
    headings = next(line for line in printed.splitlines() if line.startswith("|"))
    shown = [cell.strip() for cell in headings.strip("|").split("|")]
    assert shown[:4] == ["policy", "bound", "tasks", "lost"]
    assert "mean ms" in shown
    assert HEADINGS["at_one_speed"].markdown not in shown
    assert "at_one_speed" in printed.partition("Not printed: ")[2]


def test_a_note_of_a_line_takes_no_room_in_the_table() -> None:
    """The note is printed above the table, with the name of its line."""
    printed = ColumnSettings().text([TABLE])
    assert "- paper: no outage" in printed
    assert lines_of(printed)[0][0] == "paper"


def test_all_prints_every_column() -> None:
    """--all prints the columns that do not fit, too."""
    assert len(lines_of(ColumnSettings(all_columns=True).text([TABLE]))[0]) == len(HEADINGS)


def test_chosen_columns_are_printed_with_those_of_text() -> None:
    """--columns keeps the names of the lines; the columns stay in the order of the table."""
    printed = ColumnSettings(columns=("p95_ms", "tasks")).text([TABLE])
    assert lines_of(printed)[1] == ["hedge:probe:greedy@k-means", "", "200", "321.0"]


def test_csv_and_json_hold_all_columns() -> None:
    """The default cuts no file that a program reads."""
    (table,) = json.loads(ColumnSettings(format="json").text([TABLE]))["tables"]
    assert table["scores"][0].keys() >= HEADINGS.keys()
    assert ColumnSettings(format="csv").text([TABLE]).splitlines()[0].count(",") >= len(HEADINGS)


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--columns", "regret"], "--columns: unknown column 'regret'; did you mean 'regret_s'?"),
        (["--columns", "regret_s", "--all"], "--columns: regret_s cannot be combined with --all"),
        (["--columns", "regret_s", "--format", "csv"], "--columns: regret_s needs --format md or latex"),
    ],
)
@pytest.mark.parametrize("command", ["table", "replay"])
def test_a_wrong_choice_is_one_line(
    command: str, flags: list[str], said: str, dataset: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A mistake of the user is one line on stderr and exit code 2."""
    assert main([command, str(dataset), *flags]) == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    assert said in shown.err
    assert shown.err.count("\n") == 1


def test_a_comparison_refuses_an_unknown_column_before_it_plays(tmp_path: Path) -> None:
    """A comparison may take hours, so the name is checked first."""
    out = tmp_path / "out"
    assert main(["compare", "calm", "--columns", "mean", "--out", str(out)]) == 2
    assert not out.exists()
