"""The logs of a robot and a server that run as processes."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
TASKS = 5

pytestmark = pytest.mark.integration


def test_robot_and_server_log_each_task_as_json(testbed: Callable[..., Any]) -> None:
    """With `--log debug --log-format json` every line is JSON, and one line is about each task."""
    bed = testbed({"log": "debug", "log_format": "json"})
    command = ["call", "--task", "tests.probes:nap", "--sizes", "constant:0", "--tasks", str(TASKS)]
    command += ["--cloud", bed.endpoint, "--policy", "cloud", "--log", "debug", "--log-format", "json"]
    run = [sys.executable, "-m", "offboard.loadgen", *command]
    done = subprocess.run(run, capture_output=True, text=True, timeout=50, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr
    asked = tasks_of(done.stderr)
    found = [(one["i"], one["kind"], one["used"]) for one in asked]
    assert found[-TASKS:] == [(i, "nap", "cloud") for i in range(TASKS)], "the first ones warm the sites up"
    ran = [one for one in tasks_of((bed.out / "logs" / "cloud.log").read_text()) if one["kind"] == "nap"]
    answered = [one for one in ran if one["status"] == "ok"]
    assert len(answered) >= TASKS, ran
    assert all(one["run_s"] > 0 for one in answered), ran


def tasks_of(log: str) -> list[dict[str, Any]]:
    """What the lines about tasks say; each line must be JSON."""
    lines = [json.loads(line) for line in log.splitlines()]
    return [line["task"] for line in lines if "task" in line]
