"""`loadgen compare --simulate`: its tables in every format, and one line for what cannot be."""

import csv
import io
import json
from collections.abc import Callable

import pytest

from offboard.loadgen.__main__ import main
from offboard.loadgen.compare.simulated_tables import summary_table
from offboard.loadgen.table.table_formats import FORMATS, Table, render

TABLES = (
    "compare",
    "nonlinear",
    "heavy-tail",
    "--simulate",
    "--policies",
    "cloud,hedge:probe:greedy@average",
)
FEW = ("--seeds", "2", "--tasks", "40", "--from-task", "10", "--jobs", "1")


@pytest.fixture
def printed(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """What the command prints for two scenarios with these flags."""

    def run(*flags: str) -> str:
        assert main([*TABLES, *FEW, *flags]) == 0
        return capsys.readouterr().out

    return run


def test_a_table_over_all_scenarios_comes_first(printed: Callable[..., str]) -> None:
    """A line a policy with mean, worst and every scenario; then a table of each scenario."""
    tables = json.loads(printed("--format", "json"))["tables"]
    summary, *each = tables
    assert [line["policy"] for line in summary["scores"]] == ["cloud", "hedge:probe:greedy@average"]
    for line in summary["scores"]:
        figures = [line["on_nonlinear"], line["on_heavy_tail"]]
        assert line["worst"] == max(figures)
        assert line["mean"] == pytest.approx(sum(figures) / 2)
        of_each = [
            next(one for one in table["scores"] if one["policy"] == line["policy"] and not one["bound"])
            for table in each
        ]
        assert figures == [one["time_over_oracle"] for one in of_each]
        assert {(one["tasks"], one["referenced"], one["lost"]) for one in of_each} == {(60, 60, 0)}
        assert all(50 < one["coverage_percent"] <= 100 for one in of_each)
    assert [table["testbed"] for table in each] == ["simulation", "simulation"]


@pytest.mark.parametrize("format", FORMATS)
def test_every_format_holds_it(printed: Callable[..., str], format: str) -> None:
    """Twice the same, to the letter."""
    text = printed("--format", format)
    assert text == printed("--format", format)
    if format == "csv":
        first, second = text.split("\n\n")
        assert [row["policy"] for row in csv.DictReader(io.StringIO(first))] == [*TABLES[-1].split(",")]
        assert {row["scenario"] for row in csv.DictReader(io.StringIO(second))} == {"nonlinear", "heavy-tail"}


def test_one_scenario_needs_no_summary(capsys: pytest.CaptureFixture[str]) -> None:
    """Its own table says it all."""
    assert main(["compare", "nonlinear", "--simulate", "--policies", "onboard", "--tasks", "30"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("Scenario nonlinear in simulation: 3 runs of each policy with seeds 1 to 3")


def test_a_scenario_without_an_oracle_is_left_out_of_the_mean() -> None:
    """Tasks that come whatever was answered have no better site each."""
    table: Table = summary_table({"paper": {"calm": 1.2, "burst": None, "outage": 1.4}}, "all")
    assert "| paper | 1.300 | 1.400 | 1.200 | – | 1.400 |" in render([table], "md")  # noqa: RUF001


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["calm", "--jobs", "2"], "--jobs: 2 needs --simulate"),
        (["calm", "--simulate", "--jobs", "0"], "--jobs: 0 is below 1"),
        (["calm", "--simulate", "--policies", "clod"], "--policies: 'clod' is not one of"),
        (
            ["calm", "--simulate", "--testbed", "docker"],
            "--testbed: docker cannot be combined with --simulate",
        ),
        (["soak", "--simulate"], "scenario soak cannot be simulated: link condition truncate_bytes"),
        (["clam", "--simulate"], "scenario 'clam' is neither a file nor one of"),
        (["calm", "--simulate", "--from-task", "500"], "--from-task: 500 is not among the 120 tasks"),
    ],
)
def test_what_cannot_be_is_one_line(
    capsys: pytest.CaptureFixture[str], arguments: list[str], said: str
) -> None:
    """Exit code 2, and nothing on stdout."""
    assert main(["compare", *arguments]) == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    assert said in shown.err
    assert shown.err.count("\n") == 1
