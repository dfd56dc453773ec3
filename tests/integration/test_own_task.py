"""Scenarios of a user, with a task module next to them, played by the installed command."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [pytest.mark.integration, pytest.mark.timeout(60)]

TASK = """from offboard.common.tasks import task


@task("twice", size=float)
def twice(number: int) -> int:
    return 2 * number
"""
SCENARIO = """name = "mine"
[workload]
task = "mytask:twice"
sizes = ["uniform:1:100"]
tasks = 12
[[check]]
figure = "wrong"
at_most = 0
[[check]]
figure = "mean_ms"
at_most = 0.001
"""
CAMERA = """import numpy as np
from offboard.common.tasks import task


@task("brightness", size=lambda frame: frame.size)
def brightness(frame: np.ndarray) -> float:
    return float(frame.mean())


def frames(seed: int):
    random = np.random.default_rng(seed)
    while True:
        yield random.integers(0, 255, (200, 300), np.uint8)
"""
WATCHING = """name = "watching"
[workload]
task = "camera:brightness"
inputs = "camera:frames"
tasks = 12
[robot]
window = 4
[[check]]
figure = "wrong"
at_most = 0
[[check]]
figure = "overhead_ms"
at_most = 0.0001
"""


def run(folder: Path, scenario: str) -> subprocess.CompletedProcess[str]:
    loadgen = Path(sys.executable).with_name("loadgen")
    return subprocess.run(
        [loadgen, "run", scenario, "--out", "out"],
        capture_output=True,
        text=True,
        timeout=50,
        cwd=folder,
    )


def test_a_scenario_with_inputs_is_played_and_verified(tmp_path: Path) -> None:
    """The answers to frames are verified, and the overhead is printed, stored and checked."""
    (tmp_path / "camera.py").write_text(CAMERA)
    (tmp_path / "watching.toml").write_text(WATCHING)
    done = run(tmp_path, "watching.toml")
    assert done.returncode == 1, done.stdout + done.stderr
    assert "12 tasks answered\n" in done.stdout
    assert "holds  wrong at most 0 tasks: 0" in done.stdout
    assert re.search(r"overhead of Offboard itself: [\d.]+ ms per task \(median\), [\d.]+ % of", done.stdout)
    assert "FAILS  overhead_ms at most 0.0001 ms: " in done.stdout
    figures = json.loads((tmp_path / "out/summary.json").read_text())["figures"]
    assert 0 < figures["overhead_ms"] < 50
    assert 0 < figures["overhead_percent"] < 100
    assert figures["unverified"] == 0


def test_a_library_that_is_missing_is_named_before_the_start(tmp_path: Path) -> None:
    """A scenario with inputs whose module cannot be imported starts no process."""
    (tmp_path / "camera.py").write_text("import no_such_library\n")
    (tmp_path / "watching.toml").write_text(WATCHING)
    done = run(tmp_path, "watching.toml")
    assert done.returncode == 2
    assert "ModuleNotFoundError: No module named 'no_such_library'" in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert done.stdout == ""


def test_all_parts_find_a_module_in_the_current_folder(tmp_path: Path) -> None:
    """Robot, server and the check of answers load it; a check that does not hold is named, exit code 1."""
    (tmp_path / "mytask.py").write_text(TASK)
    (tmp_path / "mine.toml").write_text(SCENARIO)
    done = run(tmp_path, "mine.toml")
    assert done.returncode == 1, done.stdout + done.stderr
    assert "holds  wrong at most 0 tasks: 0" in done.stdout
    assert "FAILS  mean_ms at most 0.001 ms: " in done.stdout
    assert " above the limit" in done.stdout
    assert done.stderr == "loadgen run: 1 of 2 checks of mine failed\n"
