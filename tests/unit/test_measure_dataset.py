"""Datasets: exporting rows, their notes, and what measuring in containers needs."""

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.figures.step import DATASETS
from offboard.common.errors import ConfigError, DataError
from offboard.loadgen.export.export import ExportConfig, run_export
from offboard.loadgen.play.measure_dataset import DatasetConfig, _conditions, _settings, run_dataset
from offboard.loadgen.play.play_scenario import play
from offboard.loadgen.scenario.scenario_file import find_scenario, read_scenario
from offboard.loadgen.table.measured_rows import read
from offboard.loadgen.table.measurement_notes import notes
from offboard.loadgen.table.table_formats import render
from offboard.loadgen.table.table_settings import TableConfig
from offboard.loadgen.table.table_two import read_tables
from offboard.robot_client.policies import Decision
from offboard.robot_client.records.record import Record
from offboard.robot_client.records.trace import Trace
from offboard.robot_client.sites.runner import Execution

ROOT = Path(__file__).parents[2]
CSV = "size,onboard_s,cloud_s\n1,0.1,0.2\n2,0.2,0.1\n3,0.3,0.1\n"


def test_exported_rows_are_read_back_exactly(tmp_path: Path) -> None:
    """Exported rows keep their last digit, and a task without both times is left out."""
    trace = Trace(tmp_path / "trace.jsonl")
    for i in range(5):
        sites = {"onboard": 0.1 + i / 3, "cloud": 0.2 + i / 7} if i != 2 else {"onboard": 0.1}
        moved = {"cloud": {"bytes_out": 90 + i, "bytes_in": 10}}
        executions = tuple(Execution(site, s, **moved.get(site, {})) for site, s in sites.items())
        decision = Decision("onboard", "", "pinned", both=len(sites) > 1)
        trace.write(Record(i, str(i), "plan", i / 9, {}, decision, executions, "onboard", 0.1))
    trace.close()
    out = tmp_path / "new" / "d.csv"
    assert run_export(trace.path, ExportConfig(csv=out)) == 0
    written, known = read(out), read(trace.path)
    assert len(written) == 4
    assert (
        out.read_text().splitlines()[0] == "size,onboard_s,cloud_s,cloud_bytes_out,cloud_bytes_in,timeout_s"
    )
    for name in ("size", "onboard_s", "cloud_s"):
        np.testing.assert_array_equal(getattr(written, name), getattr(known, name))


def test_a_failed_export_leaves_no_file(tmp_path: Path) -> None:
    """If the file cannot be written, the error names it and no partial file is left."""
    (tmp_path / "d.csv").write_text(CSV)
    (tmp_path / "folder.csv").mkdir()
    with pytest.raises(ConfigError, match=r"folder\.csv: cannot be written: is a folder"):
        run_export(tmp_path / "d.csv", ExportConfig(csv=tmp_path / "folder.csv"))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["d.csv", "folder.csv"]


@pytest.mark.parametrize("name", DATASETS)
def test_the_settings_of_a_dataset_name_no_folder_of_this_computer(name: str) -> None:
    """They can be written as JSON, with the names of maps and recordings."""
    scenario = read_scenario(find_scenario(name))
    written = json.dumps(_settings(scenario)) + _conditions(scenario, "docker")
    assert str(ROOT) not in written
    for file in scenario.link.values():
        assert not isinstance(file, Path) or file.name in written


def test_notes_are_printed_with_the_table(tmp_path: Path) -> None:
    """The notes in NAME.json are printed below the caption of every table of NAME.csv."""
    (tmp_path / "d.csv").write_text(CSV)
    (tmp_path / "d.json").write_text(json.dumps({"notes": ["Robot 0.2 CPU.", "Ratio 1.02."]}))
    tables = read_tables(tmp_path / "d.csv", TableConfig(windows=("2",)))
    lines = render(tables, "md").splitlines()
    assert lines[1:3] == ["- Robot 0.2 CPU.", "- Ratio 1.02."]
    (table,) = json.loads(render(tables, "json"))["tables"]
    assert table["notes"] == ["Robot 0.2 CPU.", "Ratio 1.02."]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("{", r"d\.json: no notes found: Expecting property name"),
        ("[]", r"d\.json: no notes found: list indices"),
        ("{}", r"d\.json: no notes found: 'notes'"),
        ('{"notes": "x"}', r"d\.json: notes is not a list of lines"),
        ('{"notes": [1]}', r"d\.json: notes is not a list of lines"),
    ],
)
def test_a_foreign_json_file_is_refused(tmp_path: Path, text: str, expected: str) -> None:
    """A NAME.json that `loadgen dataset` did not write is an error that names the file."""
    (tmp_path / "d.json").write_text(text)
    with pytest.raises(DataError, match=expected):
        notes(tmp_path / "d.csv")


@pytest.mark.parametrize(
    ("docker", "said"),
    [
        (None, r"docker cannot be run: .*No such file"),
        (
            "echo Cannot connect >&2; exit 1",
            r"docker: `docker compose version` failed: Cannot connect",
        ),
        (
            'test "$2" = version || exit 0; echo unknown command >&2; exit 125',
            r"docker: `docker compose version` failed: unknown command",
        ),
    ],
)
def test_containers_need_an_engine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, docker: str | None, said: str
) -> None:
    """Without Docker, its engine or Compose the error quotes Docker's own message, and nothing is written."""
    if docker is not None:
        (tmp_path / "docker").write_text(f"#!/bin/sh\n{docker}\n")
        (tmp_path / "docker").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    Path("docker-compose.yml").touch()
    with pytest.raises(ConfigError, match=f"--testbed: {said}"):
        play(read_scenario(ROOT / "loadgen" / "scenarios" / "paper.toml"), tmp_path / "out", "docker")
    assert not (tmp_path / "out").exists()


def test_containers_need_a_checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Outside a checkout the error says so, and nothing is written."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=r"--testbed: docker: docker-compose\.yml not found; run this in a"):
        run_dataset("paper", DatasetConfig(), ["loadgen", "dataset", "paper"])
    assert not list(tmp_path.iterdir())
