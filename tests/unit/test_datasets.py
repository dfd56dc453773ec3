"""The committed datasets, and the tables of them on the results page."""

import json
from pathlib import Path

import pytest

from offboard.loadgen.scenario.scenario_file import shipped
from offboard.loadgen.table.measured_rows import read
from offboard.loadgen.table.predictor_evaluation import Evaluation
from offboard.loadgen.table.table_settings import PAPER_WINDOWS, TableConfig
from offboard.loadgen.table.table_two import table_text
from tests.table_loops import expected_table, lines_of, replay, rows_of

FOLDER = Path(__file__).parents[2] / "loadgen" / "datasets"
RESULTS = (FOLDER.parents[1] / "docs" / "results.md").read_text(encoding="utf-8")
ON_THE_PAGE = ("congested", "paper")
NAMES = sorted(path.stem for path in FOLDER.glob("*.csv"))


def test_every_dataset_has_its_json_file() -> None:
    """Each CSV has a JSON file that says how it was measured, and a scenario that measures it again."""
    assert set(ON_THE_PAGE) <= set(NAMES) <= set(shipped())
    assert sorted(path.stem for path in FOLDER.glob("*.json")) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_a_dataset_holds_a_thousand_measured_rows(name: str) -> None:
    """Its JSON file names the number of rows, the commit, the settings and the disturbance."""
    rows, about = read(FOLDER / f"{name}.csv"), json.loads((FOLDER / f"{name}.json").read_text())
    assert len(rows) == about["rows"] == 1000
    assert about["testbed"] == "docker"
    assert "dirty" not in about["commit"]
    assert about["scenario"]["name"] == name
    assert about["disturbance"]["plans"] == 100


@pytest.mark.parametrize("feedback", ["chosen", "full"])
@pytest.mark.parametrize("name", NAMES)
def test_every_printed_figure_equals_plain_loops(name: str, feedback: str) -> None:
    """On measured rows, too, every printed figure equals an independent computation."""
    text = (FOLDER / f"{name}.csv").read_text()
    found = lines_of(table_text(FOLDER / f"{name}.csv", TableConfig(feedback=feedback)))
    assert found == expected_table(rows_of(text), PAPER_WINDOWS, feedback)


@pytest.mark.parametrize("feedback", ["chosen", "full"])
@pytest.mark.parametrize("name", NAMES)
def test_every_prediction_equals_plain_loops(name: str, feedback: str) -> None:
    """Every prediction is right to 1e-9 s, for short and long windows and for full."""
    lines, rows = rows_of((FOLDER / f"{name}.csv").read_text()), read(FOLDER / f"{name}.csv")
    evaluation = Evaluation(rows, TableConfig())
    for window in ("5", "50", "500", "full"):
        found = evaluation.predictions("least-squares", window, feedback)
        assert found is not None
        length = 800 if window == "full" else int(window)
        steps = replay(lines, length, length, "none" if window == "full" else feedback)
        assert found.cloud_predicted_s == pytest.approx([step.p_cloud for step in steps], rel=0, abs=1e-9)
        assert found.onboard_predicted_s == pytest.approx([step.p_onboard for step in steps], rel=0, abs=1e-9)


@pytest.mark.parametrize("feedback", ["chosen", "full"])
@pytest.mark.parametrize("name", ON_THE_PAGE)
def test_the_page_prints_what_the_command_prints(name: str, feedback: str) -> None:
    """Each figure in the tables of the page equals the command's figure under the same heading."""
    printed = table_text(FOLDER / f"{name}.csv", TableConfig(feedback=feedback)).splitlines()
    headings, lines = cells(printed[-15]), [cells(line) for line in printed[-13:]]
    section = RESULTS.split(f"### {name}.csv, feedback {feedback}\n")[1].split("\n#")[0]
    page = [line for line in section.splitlines() if line.startswith("|")]
    places = [headings.index(heading) for heading in cells(page[0])]
    assert len(places) == 16
    assert [cells(line) for line in page[2:]] == [[line[place] for place in places] for line in lines]


def cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip("|").split("|")]
