"""Plays a scenario in containers: docker-compose.yml with the scenario's settings laid over it.

Needs the checkout, a Docker engine and Compose v2; the services are described in that file.
"""

import json
import os
import signal
import subprocess
from collections.abc import Sequence
from pathlib import Path
from types import FrameType
from typing import Any

from common.errors import ConfigError, OffloadError
from loadgen.flags import as_flags
from loadgen.part import uninterrupted
from loadgen.play import TRACE, cloud_args, make_room, robot_args
from loadgen.scenario import Scenario

FILE = Path("docker-compose.yml")
PROJECT = "offboard-run"
PERIOD_US = 10_000  # as in docker-compose.yml
MAPS = Path("/maps")
SAMPLES = Path("/samples")
RESULTS = Path("/out")
ASK_S = 30
DOWN_S = 120
COPY_S = 60


def play_in_containers(scenario: Scenario, out: Path) -> int:
    """Play to the end; the robot's exit code. OUT/trace.jsonl is as `play.play` leaves it.

    The containers are taken away again, whatever happens.
    """
    if not FILE.is_file():
        raise ConfigError(f"--testbed: docker needs {FILE} of a checkout in the current folder")
    _check_engine()
    make_room(out)
    overlay = out / "compose.json"
    overlay.write_text(json.dumps(_overlay(scenario), indent=2))
    compose = ("docker", "compose", "--progress", "quiet", "-p", PROJECT, "-f", str(FILE), "-f", str(overlay))
    before = signal.signal(signal.SIGTERM, _exit)
    try:
        _run(*compose, "build", "cloud", "wan", "robot")
        code = _run(
            *(*compose, "up", "--no-build", "--attach", "robot", "--no-log-prefix"),
            *("--abort-on-container-exit", "--exit-code-from", "robot", "robot"),
            codes=range(256),
        )
        _run(*compose, "cp", f"robot:{RESULTS}/.", str(out), timeout_s=COPY_S)
    finally:
        with uninterrupted():
            _run(*compose, "down", "--volumes", "--remove-orphans", timeout_s=DOWN_S, codes=range(256))
        signal.signal(signal.SIGTERM, before)
    print(f"written: {out / TRACE}", flush=True)
    return code


def _check_engine() -> None:
    """ConfigError, with what Docker said, where no engine with Compose v2 answers."""
    for question in (("docker", "info"), ("docker", "compose", "version")):
        try:
            done = subprocess.run(question, capture_output=True, text=True, timeout=ASK_S, check=False)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise ConfigError(f"--testbed: docker cannot be asked: {error}") from error
        if done.returncode != 0:
            said = (done.stderr.strip() or "nothing").splitlines()[-1]
            raise ConfigError(f"--testbed: docker does not answer to `{' '.join(question)}`: {said}")


def _overlay(scenario: Scenario) -> dict[str, Any]:
    """What the scenario says, as a Compose file (JSON is YAML)."""
    place = MAPS / scenario.workload.map.name
    robot = robot_args(scenario, place, RESULTS / TRACE)
    link, samples = dict(scenario.link), []
    for name, value in scenario.link.items():
        if isinstance(value, Path):
            link[name] = SAMPLES / name
            samples.append(f"{value}:{link[name]}:ro")
    services = {
        "cloud": {
            "command": ["--listen", "tcp://*:5555", "--http", "0.0.0.0:8000", *cloud_args(scenario)],
        },
        "wan": {
            "command": [
                *("wan", "--listen", "0.0.0.0:5555", "--to", "cloud:5555", "--http", "0.0.0.0:8001"),
                *as_flags(link),
                f"--seed={scenario.seed}",
            ],
            "volumes": samples,
        },
        "robot": {
            "command": ["--cloud", "tcp://wan:5555", *robot],
            "cpu_quota": round(scenario.robot.cpus * PERIOD_US),
            "volumes": [f"{scenario.workload.map.parent}:{MAPS}:ro"],
        },
    }
    return {"services": services}


def _run(*command: str, timeout_s: float | None = None, codes: Sequence[int] = (0,)) -> int:
    """Run to the end, showing its output; OffloadError where the exit code is none of `codes`."""
    free_ports = {"CLOUD_HTTP_PORT": "0", "WAN_HTTP_PORT": "0"}
    try:
        done = subprocess.run(command, env=os.environ | free_ports, timeout=timeout_s, check=False)
    except subprocess.TimeoutExpired as error:
        raise OffloadError(f"{' '.join(command)}: not done after {timeout_s:g} s") from error
    if done.returncode not in codes:
        raise OffloadError(f"{' '.join(command)}: exit code {done.returncode}")
    return done.returncode


def _exit(number: int, _frame: FrameType | None) -> None:
    raise SystemExit(128 + number)
