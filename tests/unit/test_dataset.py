"""Datasets: what is written beside the rows, what is read back, and what the containers are told."""

import json
from pathlib import Path

import numpy as np
import pytest

from offboard.common.errors import ConfigError, DataError
from offboard.loadgen.play.dataset import DatasetConfig, ExportConfig, run_dataset, run_export
from offboard.loadgen.play.play import play
from offboard.loadgen.scenario.scenario import read_scenario
from offboard.loadgen.table.notes import notes
from offboard.loadgen.table.rows import read
from offboard.loadgen.table.table_two import TableConfig, table_text
from offboard.robot_client.policies import Decision
from offboard.robot_client.records.trace import Record, Trace
from offboard.robot_client.sites.runner import Execution

ROOT = Path(__file__).parents[2]
CSV = "size,onboard_s,cloud_s\n1,0.1,0.2\n2,0.2,0.1\n3,0.3,0.1\n"


def test_export_writes_what_read_reads(tmp_path: Path) -> None:
    """The rows come back to the last digit; a task without both times is left out."""
    trace = Trace(tmp_path / "trace.jsonl")
    for i in range(5):
        sites = {"onboard": 0.1 + i / 3, "cloud": 0.2 + i / 7} if i != 2 else {"onboard": 0.1}
        executions = tuple(Execution(site, seconds) for site, seconds in sites.items())
        decision = Decision("onboard", "", "pinned", both=len(sites) > 1)
        trace.write(Record(i, str(i), "plan", i / 9, {}, decision, executions, "onboard", 0.1))
    trace.close()
    out = tmp_path / "new" / "d.csv"
    assert run_export(trace.path, ExportConfig(csv=out)) == 0
    written, known = read(out), read(trace.path)
    assert len(written) == 4
    assert out.read_text().splitlines()[0] == "size,onboard_s,cloud_s"
    for name in ("size", "onboard_s", "cloud_s"):
        np.testing.assert_array_equal(getattr(written, name), getattr(known, name))


def test_export_that_cannot_write_leaves_the_old_file(tmp_path: Path) -> None:
    """One line names the file; nothing is half written."""
    (tmp_path / "d.csv").write_text(CSV)
    (tmp_path / "folder.csv").mkdir()
    with pytest.raises(ConfigError, match=r"folder\.csv: cannot be written: Is a directory"):
        run_export(tmp_path / "d.csv", ExportConfig(csv=tmp_path / "folder.csv"))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["d.csv", "folder.csv"]


def test_notes_are_printed_with_the_table(tmp_path: Path) -> None:
    """What NAME.json says of the measurement stands under the caption of every table of NAME.csv."""
    (tmp_path / "d.csv").write_text(CSV)
    (tmp_path / "d.json").write_text(json.dumps({"notes": ["Robot 0.2 CPU.", "Ratio 1.02."]}))
    lines = table_text(tmp_path / "d.csv", TableConfig(windows=("2",))).splitlines()
    assert lines[1:3] == ["- Robot 0.2 CPU.", "- Ratio 1.02."]
    (table,) = json.loads(table_text(tmp_path / "d.csv", TableConfig(windows=("2",), format="json")))[
        "tables"
    ]
    assert table["notes"] == ["Robot 0.2 CPU.", "Ratio 1.02."]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("{", r"d\.json: holds no notes: Expecting property name"),
        ("[]", r"d\.json: holds no notes: list indices"),
        ("{}", r"d\.json: holds no notes: 'notes'"),
        ('{"notes": "x"}', r"d\.json: notes: not a list of lines"),
        ('{"notes": [1]}', r"d\.json: notes: not a list of lines"),
    ],
)
def test_notes_of_somebody_else_are_named(tmp_path: Path, text: str, expected: str) -> None:
    """A NAME.json that `loadgen dataset` did not write is one DataError."""
    (tmp_path / "d.json").write_text(text)
    with pytest.raises(DataError, match=expected):
        notes(tmp_path / "d.csv")


@pytest.mark.parametrize(
    ("docker", "said"),
    [
        (None, r"docker cannot be asked: .*No such file"),
        (
            "echo Cannot connect >&2; exit 1",
            r"docker does not answer to `docker compose version`: Cannot connect",
        ),
        (
            'test "$2" = version || exit 0; echo unknown command >&2; exit 125',
            r"docker does not answer to `docker compose version`: unknown command",
        ),
    ],
)
def test_containers_need_an_engine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, docker: str | None, said: str
) -> None:
    """No docker, no engine, no Compose: one line with what docker said, and nothing is written."""
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
    """Elsewhere one line says what is missing, before anything is written."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=r"--testbed: docker needs docker-compose\.yml of a checkout"):
        run_dataset("paper", DatasetConfig(), ["loadgen", "dataset", "paper"])
    assert not list(tmp_path.iterdir())
