"""A scenario of a user, with a task module next to it, played by the installed command."""

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


def test_all_parts_find_a_module_in_the_current_folder(tmp_path: Path) -> None:
    """Robot, server and the check of answers load it; a check that does not hold is named, exit code 1."""
    (tmp_path / "mytask.py").write_text(TASK)
    (tmp_path / "mine.toml").write_text(SCENARIO)
    loadgen = Path(sys.executable).with_name("loadgen")
    done = subprocess.run(
        [loadgen, "run", "mine.toml", "--out", "out"],
        capture_output=True,
        text=True,
        timeout=50,
        cwd=tmp_path,
    )
    assert done.returncode == 1, done.stdout + done.stderr
    assert "holds  wrong at most 0 tasks: 0" in done.stdout
    assert "FAILS  mean_ms at most 0.001 ms: " in done.stdout
    assert " above the limit" in done.stdout
    assert done.stderr == "loadgen run: 1 of 2 checks of mine failed\n"
