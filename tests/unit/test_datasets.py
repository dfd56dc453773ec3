"""The committed datasets, and the tables of them on the results page."""

import hashlib
import json
from pathlib import Path

import pytest

from benchmarks.figures.markdown_tables import tables_of
from benchmarks.figures.step import DATASETS
from offboard.loadgen.scenario.scenario_file import shipped
from offboard.loadgen.table.measured_rows import read
from offboard.loadgen.table.table_formats import render
from offboard.loadgen.table.table_settings import PAPER_WINDOWS, TableConfig
from offboard.loadgen.table.table_two import Evaluation, read_tables
from tests.table_loops import expected_table, lines_of, replay, rows_of

FOLDER = Path(__file__).parents[2] / "loadgen" / "datasets"
FIGURES = FOLDER.parents[1] / "docs" / "figures"
OTHERS = {"robot-busy": 400}  # rows; for one claim of the paper, and in no table of all datasets
NAMES = sorted(path.stem for path in FOLDER.glob("*.csv"))


def test_every_dataset_has_its_json_file() -> None:
    """Each CSV has a JSON file that says how it was measured, and a step that measures it again."""
    assert set(NAMES) == {*DATASETS, *OTHERS} <= set(shipped())
    assert sorted(path.stem for path in FOLDER.glob("*.json")) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_a_dataset_holds_all_rows_that_were_asked_for(name: str) -> None:
    """Its JSON file names the number of rows, the commit, the settings and the disturbance."""
    rows, about = read(FOLDER / f"{name}.csv"), json.loads((FOLDER / f"{name}.json").read_text())
    assert len(rows) == about["rows"] == OTHERS.get(name, 1000)
    assert about["testbed"] == "docker"
    assert "dirty" not in about["commit"]
    assert about["scenario"]["name"] == name
    assert about["disturbance"]["plans"] == 100


@pytest.mark.parametrize("feedback", ["chosen", "full"])
@pytest.mark.parametrize("name", NAMES)
def test_every_printed_figure_equals_plain_loops(name: str, feedback: str) -> None:
    """On measured rows, too, every printed figure equals an independent computation."""
    text = (FOLDER / f"{name}.csv").read_text()
    rows = rows_of(text)
    windows = tuple(one for one in PAPER_WINDOWS if one == "full" or int(one) < len(rows))
    config = TableConfig(feedback=feedback, windows=windows)
    found = lines_of(render(read_tables(FOLDER / f"{name}.csv", config), "md"))
    assert found == expected_table(rows, windows, feedback)


@pytest.mark.parametrize("feedback", ["chosen", "full"])
@pytest.mark.parametrize("name", NAMES)
def test_every_prediction_equals_plain_loops(name: str, feedback: str) -> None:
    """Every prediction is right to 1e-9 s, for short and long windows and for full."""
    lines, rows = rows_of((FOLDER / f"{name}.csv").read_text()), read(FOLDER / f"{name}.csv")
    evaluation = Evaluation(rows, TableConfig())
    for window in ("5", "50", "500", "full"):
        length = len(lines) * 4 // 5 if window == "full" else int(window)
        if length >= len(lines):
            continue
        found = evaluation.predictions("least-squares", window, feedback)
        assert found is not None
        steps = replay(lines, length, length, "none" if window == "full" else feedback)
        assert found.cloud_predicted_s == pytest.approx([step.p_cloud for step in steps], rel=0, abs=1e-9)
        assert found.onboard_predicted_s == pytest.approx([step.p_onboard for step in steps], rel=0, abs=1e-9)


@pytest.mark.parametrize("name", DATASETS)
def test_the_results_page_has_what_the_command_prints(name: str) -> None:
    """The file of `make figures` holds what `loadgen table` prints for these rows, digit by digit."""
    file = FIGURES / "table-two" / f"{name}.json"
    if not file.exists():
        pytest.skip(f"{name}.csv is not measured yet: make figures")
    measured = json.loads(file.read_text())
    rows = measured["reads"][f"loadgen/datasets/{name}.csv"]
    if rows["sha256"] != hashlib.sha256((FOLDER / f"{name}.csv").read_bytes()).hexdigest():
        pytest.skip(f"the file is of other rows of {name}.csv, as the page says: make figures")
    config = TableConfig(feedback="both", all_columns=True)
    lines = config.text(read_tables(FOLDER / f"{name}.csv", config)).splitlines()
    tables = tables_of(lines)
    assert len(tables) == 2  # of each feedback
    assert tables == tables_of(measured["output"])
