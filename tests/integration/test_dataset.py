"""`loadgen dataset` with real processes."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from offboard.loadgen.table.measured_rows import read

pytestmark = [pytest.mark.integration, pytest.mark.timeout(180)]

ROOT = Path(__file__).parents[2]


def loadgen(*args: str, cwd: Path = ROOT) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "offboard.loadgen", *args],
        capture_output=True,
        text=True,
        timeout=150,
        cwd=cwd,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_a_dataset_says_how_it_was_measured(tmp_path: Path) -> None:
    """Its JSON file holds settings, machine and disturbance, and `loadgen table` prints its notes."""
    out = loadgen(
        *("dataset", "paper", "--testbed", "local", "--rows", "12", "--alone", "3", "--seed", "9"),
        *("--out", str(tmp_path), "--run", str(tmp_path / "run")),
    )
    assert f"written: {tmp_path / 'paper.csv'} (12 rows, 0 left out)" in out
    rows, about = read(tmp_path / "paper.csv"), json.loads((tmp_path / "paper.json").read_text())
    assert len(rows) == about["rows"] == 12
    assert (about["testbed"], about["scenario"]["seed"]) == ("local", 9)
    assert about["machine"]["cores"] >= 1
    assert about["command"].startswith("loadgen dataset paper --testbed local")
    onboard = about["disturbance"]["sites"]["onboard"]
    assert onboard["seconds"]["pairs"] == 3
    assert 0.1 < onboard["cpu_share"] < 1.1, onboard  # a plan computes; a short one ends within its quota
    table = loadgen("table", "paper.csv", "--windows", "5", cwd=tmp_path)
    assert "robot 0.2 CPU" in table
    assert "onboard, total time: " in table
