"""`loadgen export --mcap` of a short demo run with real processes, read back by mcap and by rosbags."""

import subprocess
import sys
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from offboard.loadgen.robot import answers
from offboard.loadgen.robot.work import read_prior
from offboard.loadgen.robot_files import read_trace
from offboard.robot_client.sites.runner import CLOUD, ONBOARD
from offboard.ros2.converters import grid_of, path_poses
from tests.mcaps import counts, of, read_both

pytestmark = [pytest.mark.integration, pytest.mark.timeout(240)]

ROOT = Path(__file__).parents[2]
TASKS = 16


def loadgen(*args: str | Path) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "offboard.loadgen", *map(str, args)],
        capture_output=True,
        text=True,
        timeout=150,
        cwd=ROOT,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a short demo run, with its MCAP file."""
    out = tmp_path_factory.mktemp("demo")
    loadgen("run", "demo", "--tasks", str(TASKS), "--out", out)
    said = loadgen("export", out, "--mcap", out / "demo.mcap")
    assert f"demo.mcap ({TASKS} tasks, " in said
    return out


def test_every_message_is_decoded_and_counted(run: Path) -> None:
    """Both libraries decode all messages, in the order of time; each topic has as many as the run's files."""
    found = counts(read_both(run / "demo.mcap"))
    records, lines = list(read_trace(run / "trace.jsonl")), list(answers.read(run / "answers.jsonl"))
    assert len(records) == len(lines) == TASKS
    expected = dict.fromkeys(("/scan", "/pose", "/goal_pose", "/tf", "/diagnostics"), TASKS)
    expected |= {"/map": 1, "/offboard/waited_ms": TASKS}
    expected["/plan"] = sum(line["answer"] is not None for line in lines)
    for site in (ONBOARD, CLOUD):
        known = [record["sites"][site]["predicted_s"] is not None for record in records]
        answered = [one["ok"] for record in records for one in record["executions"] if one["site"] == site]
        expected |= {f"/offboard/predicted_ms/{site}": sum(known), f"/offboard/true_ms/{site}": sum(answered)}
    assert found == expected
    assert min(expected.values()) > 0


def test_map_paths_and_times_are_those_of_the_run(run: Path) -> None:
    """The map is that of the scenario, each path that of the answers file, each time that of the trace."""
    said = read_both(run / "demo.mcap")
    prior = read_prior(ROOT / "maps/willow-full-0.05.yaml", 0.025)
    ((_, grid),) = of(said, "/map")
    np.testing.assert_array_equal(grid_of(grid).cells, prior.cells)
    lines = list(answers.read(run / "answers.jsonl"))
    for line, (_, path) in zip(lines, of(said, "/plan"), strict=True):
        metres = prior.metres(answers.cells_of(line["answer"]))
        np.testing.assert_allclose(path_poses(path)[:, :2], metres, atol=prior.resolution / 2 + 1e-6)
        np.testing.assert_allclose(path_poses(path)[1:-1, :2], metres[1:-1], atol=1e-5)
    records = list(read_trace(run / "trace.jsonl"))
    for record, (stamp, scan) in zip(records, of(said, "/scan"), strict=True):
        started_s = datetime.fromisoformat(record["started_at"]).timestamp()
        assert stamp / 1e9 == pytest.approx(started_s, abs=0.5)
        assert (np.asarray(scan.ranges) < scan.range_max).any(), "the robot sees a wall"
    for site in (ONBOARD, CLOUD):
        seconds = [one["seconds"] for one in executions(records) if one["site"] == site and one["ok"]]
        assert [one.data for _, one in of(said, f"/offboard/true_ms/{site}")] == [
            1e3 * one for one in seconds
        ]


def executions(records: list[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    for record in records:
        yield from record["executions"]
