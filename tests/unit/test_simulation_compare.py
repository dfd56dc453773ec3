"""`loadgen compare --simulate`: its tables in every format, and its errors."""

import csv
import io
import json
from collections.abc import Callable

import pytest

from offboard.loadgen.__main__ import main
from offboard.loadgen.compare.compare import summary_table
from offboard.loadgen.table.table_formats import FORMATS, Table, render

TABLES = (
    "compare",
    "nonlinear",
    "heavy-tail",
    "--simulate",
    "--policies",
    "cloud,hedge:probe:greedy@least-squares",
)
FEW = ("--seeds", "2", "--tasks", "40", "--from-task", "10", "--jobs", "1")


@pytest.fixture
def printed(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Runs the command for two scenarios with these flags; returns what it prints."""

    def run(*flags: str) -> str:
        assert main([*TABLES, *FEW, *flags]) == 0
        return capsys.readouterr().out

    return run


def test_a_table_over_all_scenarios_comes_first(printed: Callable[..., str]) -> None:
    """The summary has a row for each policy, with mean, worst and every scenario; a table of each follows."""
    tables = json.loads(printed("--format", "json"))["tables"]
    summary, *each = tables
    assert [line["policy"] for line in summary["scores"]] == ["cloud", "hedge:probe:greedy@least-squares"]
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
def test_every_format_can_be_repeated(printed: Callable[..., str], format: str) -> None:
    """Two runs print the same text, in every format."""
    text = printed("--format", format)
    assert text == printed("--format", format)
    if format == "csv":
        first, second = text.split("\n\n")
        assert [row["policy"] for row in csv.DictReader(io.StringIO(first))] == [*TABLES[-1].split(",")]
        assert {row["scenario"] for row in csv.DictReader(io.StringIO(second))} == {"nonlinear", "heavy-tail"}


def test_one_scenario_has_no_summary(capsys: pytest.CaptureFixture[str]) -> None:
    """For one scenario, only its own table is printed."""
    assert main(["compare", "nonlinear", "--simulate", "--policies", "onboard", "--tasks", "30"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("Scenario nonlinear in simulation: 3 runs of each policy with seeds 1 to 3")


def test_a_flag_switches_the_heartbeats_of_all_policies(capsys: pytest.CaptureFixture[str]) -> None:
    """Without heartbeats, the paper's rule with outage detection is the paper's rule."""
    command = ["compare", "outage", "--simulate", "--seeds", "1", "--jobs", "1", "--tasks", "100"]
    command += ["--policies", "paper,paper-with-heartbeats", "--format", "json"]
    means = []
    for flags in ((), ("--no-heartbeats",)):
        assert main([*command, *flags]) == 0
        (table,) = json.loads(capsys.readouterr().out)["tables"]
        means.append({line["mean_ms"] for line in table["scores"] if not line["bound"]})
    assert [len(each) for each in means] == [2, 1]


def test_a_scenario_without_an_oracle_is_left_out_of_the_mean() -> None:
    """Open arrivals have no oracle, so their scenario has no figure and does not count in the mean."""
    table: Table = summary_table({"paper": {"calm": 1.2, "burst": None, "outage": 1.4}}, "all")
    printed = " ".join(render([table], "md").split())
    assert "| paper | 1.300 | 1.400 | 1.200 | – | 1.400 |" in printed  # noqa: RUF001


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
        (["clam", "--simulate"], "unknown scenario 'clam'; did you mean 'calm'?"),
        (["calm", "--simulate", "--from-task", "500"], "--from-task: 500 is not among the 120 tasks"),
    ],
)
def test_wrong_flags_are_one_line(
    capsys: pytest.CaptureFixture[str], arguments: list[str], said: str
) -> None:
    """A mistake of the user is one line on stderr and exit code 2; stdout stays empty."""
    assert main(["compare", *arguments]) == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    assert said in shown.err
    assert shown.err.count("\n") == 1
