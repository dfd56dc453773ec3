"""`loadgen compare` with real processes: a killed comparison is resumed."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytestmark = [pytest.mark.integration, pytest.mark.timeout(120)]

ROOT = Path(__file__).parents[2]
TASKS = 80
SCENARIO = f"""name = "small"
[workload]
task = "offboard.loadgen.scenario.hash_tasks:hash_rounds"
sizes = ["uniform:5000:30000"]
tasks = {TASKS}
reference = 10
[robot]
cpus = 0.3
window = 5
timeout = 0.3
[link]
delay_ms = 2
[[event]]
at_task = 30
link = {{ outage = true }}
[[event]]
at_task = 40
link = {{ outage = false }}
"""
POLICIES = ("paper", "onboard", "cloud")
COMMAND = (
    *(sys.executable, "-m", "offboard.loadgen", "compare", "small.toml"),
    *("--seeds", "1", "--format", "csv", "--out", "runs"),
)
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT)}
WAIT_S = 60.0


def compare(
    folder: Path, *flags: str, policies: tuple[str, ...] = POLICIES
) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(
        [*COMMAND, *flags, "--policies", ",".join(policies)],
        capture_output=True,
        text=True,
        timeout=WAIT_S,
        cwd=folder,
        env=ENVIRONMENT,
    )
    assert done.returncode == 0, done.stderr
    return done


def kill_in_the_second_run(folder: Path) -> None:
    """Run the comparison and kill it once some tasks of its second run are answered."""
    command = [*COMMAND, "--policies", ",".join(POLICIES)]
    answers, until = folder / "runs" / "small" / "1-onboard" / "answers.jsonl", time.monotonic() + WAIT_S
    with subprocess.Popen(command, cwd=folder, env=ENVIRONMENT, stderr=subprocess.DEVNULL) as process:
        while not answers.exists() or len(answers.read_bytes().splitlines()) < TASKS // 8:
            assert time.monotonic() < until, "the second run did not begin"
            time.sleep(0.01)
        process.kill()
    assert len(answers.read_bytes().splitlines()) < TASKS


def test_a_killed_comparison_is_resumed(tmp_path: Path) -> None:
    """Finished runs are used, the interrupted one is played again, and the table contains all runs."""
    (tmp_path / "small.toml").write_text(SCENARIO)
    kill_in_the_second_run(tmp_path)
    first = tmp_path / "runs" / "small" / "1-paper"
    before = {path: path.stat().st_mtime_ns for path in first.iterdir()}
    again = compare(tmp_path)
    folder = Path("runs") / "small"
    assert again.stderr.splitlines() == [
        "small, seed 1, policy paper",
        f"using the finished run in {folder / '1-paper'}",
        "small, seed 1, policy onboard",
        f"playing the run in {folder / '1-onboard'} again: it was not played to its end",
        "small, seed 1, policy cloud",
    ]
    assert {path: path.stat().st_mtime_ns for path in first.iterdir()} == before
    once_more = compare(tmp_path)
    assert once_more.stderr.count("using the finished run") == len(POLICIES)
    assert once_more.stdout == again.stdout
    heading, *lines = (line.split(",") for line in once_more.stdout.splitlines())
    measured = [dict(zip(heading, line, strict=True)) for line in lines]
    found = {one["policy"]: one for one in measured if not one["bound"]}
    assert [int(one["tasks"]) for one in found.values()] == [TASKS] * len(POLICIES)
    assert found["cloud"]["recovery"] == "0.0"  # this policy sends every task there, outage or not
    assert found["onboard"]["recovery"] == ""
    assert 0 < float(found["cloud"]["coverage_percent"]) <= 100
    reference = tmp_path / folder / "1-onboard" / "trace.reference.jsonl"
    assert reference.exists()
    quick = compare(tmp_path, "--reference", "0", policies=("onboard",))
    assert "its scenario or settings were different" in quick.stderr
    assert not reference.exists()
