"""`loadgen dataset` and `loadgen run` with containers."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from offboard.loadgen.play.play_scenario import figures, play
from offboard.loadgen.play.run_files import TRACE
from offboard.loadgen.robot_files import read_trace
from offboard.loadgen.scenario.scenario_file import find_scenario, read_scenario
from offboard.loadgen.table.measured_rows import read
from offboard.loadgen.testbed.docker_engine import PREFIX
from tests.chaos.plays import skip_if_unplayable
from tests.compose.conftest import ROOT, docker, made_by_docker

pytestmark = [pytest.mark.compose, pytest.mark.timeout(600), pytest.mark.usefixtures("engine")]

START_S, END_S = 300, 200


def loadgen(*args: str | Path) -> list[str]:
    return [sys.executable, "-m", "offboard.loadgen", *map(str, args)]


def robot_runs(host: int) -> bool:
    """Whether the robot container of this `loadgen` process is running."""
    names = docker("ps", "--format", "{{.Names}}").split()
    return any(name.startswith(f"{PREFIX}-{host}-") and name.endswith("-robot") for name in names)


def test_a_dataset_is_measured_in_containers(tmp_path: Path) -> None:
    """Every row has both times, the JSON file names the Docker version, and no container is left."""
    before = set(made_by_docker())
    done = subprocess.run(
        loadgen(
            *("dataset", "paper", "--rows", "15", "--alone", "3"),
            *("--out", tmp_path, "--run", tmp_path / "run"),
        ),
        capture_output=True,
        text=True,
        timeout=500,
        cwd=ROOT,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    about = json.loads((tmp_path / "paper.json").read_text())
    assert len(read(tmp_path / "paper.csv")) == about["rows"] == 15
    assert about["machine"]["docker"]
    said = {line["what"]: line for line in about["table_one"]}
    assert said["runs in"]["robot"] == f"a container of Docker {about['machine']['docker']}"
    assert "unknown" not in (said["system"]["robot"], said["Python"]["cloud"])
    assert about["disturbance"]["plans"] == 3
    assert set(made_by_docker()) <= before


def test_an_application_is_played_in_containers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both sites find the AprilTags of each image, in containers; no answer is lost, wrong or unverified."""
    monkeypatch.chdir(ROOT)
    scenario = read_scenario(find_scenario("apriltags-calm")).changed(tasks=12, measure_all=True)
    skip_if_unplayable(scenario)
    played = play(scenario, tmp_path, "docker", quiet=True)
    played.check_robots()
    found = figures(played.outcome, scenario)
    assert [found[name] for name in ("lost", "wrong", "unverified")] == [0, 0, 0]
    ended = [
        {one["site"] for one in record["executions"] if one["ok"]} for record in read_trace(tmp_path / TRACE)
    ]
    assert ended == 12 * [{"onboard", "cloud"}]


def test_an_interrupted_run_leaves_no_container(tmp_path: Path) -> None:
    """After Ctrl-C while the robot drives: exit code 130, and containers and networks are gone."""
    before = set(made_by_docker())
    log = tmp_path / "log"
    with log.open("w") as output:
        host = subprocess.Popen(
            loadgen("run", "paper", "--testbed", "docker", "--out", tmp_path),
            stdout=output,
            stderr=output,
            cwd=ROOT,
            start_new_session=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )
    until = time.monotonic() + START_S
    try:
        while not robot_runs(host.pid):
            assert host.poll() is None
            assert time.monotonic() < until, "the robot was not started"
            time.sleep(0.5)
        os.killpg(host.pid, signal.SIGINT)
        host.wait(END_S)
    finally:
        host.kill()
        host.wait()
    assert host.returncode == 130, log.read_text()[-2000:]
    assert set(made_by_docker()) <= before
