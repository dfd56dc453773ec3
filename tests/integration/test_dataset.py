"""`loadgen dataset` with real processes."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from offboard.loadgen.replay.dataset_file import read_dataset
from offboard.loadgen.scenario.scenario_file import find_scenario, read_scenario
from offboard.loadgen.table.measured_rows import read
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, UNMEASURED
from tests.chaos.plays import skip_if_unplayable

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
    assert "Table I of paper: robot and cloud." in out
    assert {"what": "CPU quota", "robot": "0.2 CPU", "cloud": "1 CPU"} in about["table_one"]
    assert about["machine"]["memory_gib"] > 0
    table = loadgen("table", "paper.csv", "--windows", "5", cwd=tmp_path)
    assert "robot 0.2 CPU" in table
    assert "onboard, total time: " in table
    check_replay(tmp_path)


def check_replay(folder: Path) -> None:
    """Whatever the policy of the scenario, the rows hold what policies see, and are replayed as the trace."""
    tasks = read_dataset(folder / "paper.csv")
    assert all(task.work and task.sendings[CLOUD].bytes for task in tasks)
    assert all(task.conditions[site] is not UNMEASURED for task in tasks for site in (ONBOARD, CLOUD))
    assert all(task.runs[site].run_s and task.runs[site].cpu_s for task in tasks for site in (ONBOARD, CLOUD))
    assert all(task.runs[CLOUD].bytes_out for task in tasks)
    flags = ("--window", "5", "--format", "json", "--policies", "paper,greedy,hedge:probe:greedy")
    files = ("paper.csv", "run/paper/trace.jsonl")
    of_csv, of_trace = (
        json.loads(loadgen("replay", file, *flags, cwd=folder))["tables"][0]["scores"] for file in files
    )
    assert [line | {"same_percent": None} for line in of_trace] == of_csv


def test_a_dataset_of_an_application_tells_its_parts_and_bytes(tmp_path: Path) -> None:
    """Frames of different sizes send different bytes; the parts of the time of the cloud are there."""
    skip_if_unplayable(read_scenario(find_scenario("apriltags")))
    loadgen(
        *("dataset", "apriltags", "--testbed", "local", "--rows", "8", "--alone", "1"),
        *("--out", str(tmp_path), "--run", str(tmp_path / "run")),
    )
    tasks = read_dataset(tmp_path / "apriltags.csv")
    assert len(tasks) == 8
    assert len({task.size for task in tasks}) > 1
    assert all(task.runs[CLOUD].network_s and task.runs[CLOUD].run_s for task in tasks)
    assert len({task.sendings[CLOUD].bytes for task in tasks}) == 8
