"""Tasks of a user, with their module in the current folder, run by the installed commands."""

import contextlib
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from offboard.loadgen.play.answer_verification import NEEDS_SAME

pytestmark = pytest.mark.integration

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
ENGINE = """import os
from pathlib import Path
from offboard.common.tasks import task


def load():
    with Path("setups").open("a") as setups:
        setups.write(f"{os.getpid()}\\n")
    return 2


@task("scaled", setup=load, size=float)
def scaled(engine, number: int) -> int:
    return engine * number
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
CLOUDS = """name = "clouds"
[workload]
task = "halves:centre"
inputs = "halves:clouds"
tasks = 8
[robot]
policy = "cloud"
[[check]]
figure = "wrong"
at_most = 0
"""
INPUTS = """

def clouds(seed):
    random = np.random.default_rng(seed)
    while True:
        yield random.uniform(1, 9, (100, 3))
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


@contextlib.contextmanager
def server(folder: Path, tasks: str) -> Iterator[tuple[str, int]]:
    """The endpoint and the process id of a server with one worker."""
    command = [Path(sys.executable).with_name("cloud-server"), "--tasks", tasks, "--workers", "1"]
    command += ["--listen", "tcp://127.0.0.1:0", "--http", "127.0.0.1:0"]
    with subprocess.Popen(command, cwd=folder, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stderr is not None
            ready = next(line for line in process.stderr if "listening on" in line)
            yield ready.split("listening on ")[1].split(",")[0], process.pid
        finally:
            process.kill()


def test_a_model_is_loaded_once_in_each_process(tmp_path: Path) -> None:
    """Warm-up, run, references and the tasks of --alone share the state of the robot's one worker."""
    (tmp_path / "engine.py").write_text(ENGINE)
    flags = "call --task engine:scaled --sizes uniform:1:9 --tasks 6 --reference 2 --alone 2 --trace t.jsonl"
    with server(tmp_path, "engine") as (endpoint, cloud):
        command = [Path(sys.executable).with_name("loadgen"), *flags.split(), "--cloud", endpoint]
        with subprocess.Popen(
            command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        ) as robot:
            said, errors = robot.communicate(timeout=50)
    assert robot.returncode == 0, errors
    assert "run on each site alone and on both at once: 2 of 2 tasks" in said
    assert [int(pid) for pid in (tmp_path / "setups").read_text().split()] == [cloud, robot.pid]


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


def test_packing_that_loses_detail_needs_same(tmp_path: Path) -> None:
    """Without it the run says why answers of servers are wrong; with that of own_task.md they are right."""
    page = (Path(__file__).parents[2] / "docs/own_task.md").read_text()
    (module,) = re.findall(r"```python\n# halves\.py\n(.*?)```", page, re.DOTALL)
    assert "def same(" in module
    (tmp_path / "clouds.toml").write_text(CLOUDS)
    (tmp_path / "halves.py").write_text(module.replace("def same(", "def unused(") + INPUTS)
    done = run(tmp_path, "clouds.toml")
    assert done.returncode == 1, done.stdout + done.stderr
    (said,) = [line for line in done.stdout.splitlines() if line.startswith("warning: ")]
    assert re.match(r"warning: answers that are wrong: \d; the first is that of task \d from cloud: ", said)
    assert said.endswith(NEEDS_SAME)
    (tmp_path / "halves.py").write_text(module + INPUTS)
    done = run(tmp_path, "clouds.toml")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "holds  wrong at most 0 tasks: 0" in done.stdout
    assert "warning: " not in done.stdout


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
