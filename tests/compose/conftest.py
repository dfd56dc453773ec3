"""The Compose project of the tests: built once, started once, removed at the end."""

import json
import os
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from offboard.loadgen.testbed.docker_engine import RUN

ROOT = Path(__file__).parents[2]
PROJECT = "offboard-test"
HTTP_PORT, WAN_HTTP_PORT = "18000", "18001"
ROBOT_METRICS_PORT, PROMETHEUS_PORT = "19100", "19090"
SETTINGS = {
    "TASKS": "80",
    "MEASURE": "60",
    "WINDOW": "20",
    "WINDOWS": "5,10,20",
    "CLOUD_HTTP_PORT": HTTP_PORT,
    "WAN_HTTP_PORT": WAN_HTTP_PORT,
    "ROBOT_METRICS_PORT": ROBOT_METRICS_PORT,
    "PROMETHEUS_PORT": PROMETHEUS_PORT,
}
COMMAND_S = 600


class Compose:
    """Runs `docker compose` on the project of the tests."""

    url = f"http://127.0.0.1:{HTTP_PORT}"
    wan_url = f"http://127.0.0.1:{WAN_HTTP_PORT}"

    command = ("docker", "compose", "-p", PROJECT, "--project-directory", str(ROOT))
    files = ("-f", "docker-compose.yml", "-f", "tests/compose/overlay.yml")

    def __call__(self, *args: str, check: bool = True) -> str:
        done = subprocess.run(
            [*self.command, *self.files, *args],
            cwd=ROOT,
            env=os.environ | SETTINGS,
            capture_output=True,
            text=True,
            timeout=COMMAND_S,
        )
        assert done.returncode == 0 or not check, f"docker compose {' '.join(args)}:\n{done.stderr[-3000:]}"
        return done.stdout

    @contextmanager
    def running(self, service: str, module: str) -> Iterator[tuple[str, Callable[[], Any]]]:
        """A container that answers each line with a line of JSON; its name, and a function that asks."""
        name = f"{PROJECT}-{service}-asked"
        process = subprocess.Popen(
            [*self.command, *self.files, "run", "--rm", "-T", "--no-deps", "--name", name, service, module],
            cwd=ROOT,
            env=os.environ | SETTINGS,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert process.stdin is not None
        assert process.stdout is not None

        def ask() -> Any:
            process.stdin.write("\n")
            process.stdin.flush()
            return json.loads(process.stdout.readline())

        try:
            yield name, ask
        finally:
            process.stdin.close()
            process.wait(COMMAND_S)
            process.stdout.close()

    def exit_code(self, service: str) -> int:
        """Wait until a service has ended; its exit code."""
        container = self("ps", "-aq", service).strip()
        return int(docker("wait", container))


def docker(*args: str) -> str:
    done = subprocess.run(["docker", *args], cwd=ROOT, capture_output=True, text=True, timeout=COMMAND_S)
    assert done.returncode == 0, f"docker {' '.join(args)}:\n{done.stdout[-3000:]}\n{done.stderr[-3000:]}"
    return done.stdout.strip()


def made_by_docker(run: str | None = None) -> list[str]:
    """The containers and networks of one testbed run, or of all runs."""
    mine = ("--filter", f"label={RUN}" if run is None else f"label={RUN}={run}", "--format")
    return [
        *docker("ps", "--all", *mine, "{{.Names}}").split(),
        *docker("network", "ls", *mine, "{{.Name}}").split(),
    ]


def engine_problem() -> str | None:
    """Why there is no Docker engine with Compose v2; None if there is one."""
    for command in (["docker", "info"], ["docker", "compose", "version"]):
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=30)
        except (OSError, subprocess.TimeoutExpired) as error:
            return f"{' '.join(command)}: {error}"
        if done.returncode != 0:
            return f"{' '.join(command)}: {(done.stderr.strip() or 'failed').splitlines()[-1]}"
    return None


@pytest.fixture(scope="session")
def engine() -> None:
    """A Docker engine that answers. Without one the test is skipped; in CI it fails."""
    problem = engine_problem()
    if problem and os.environ.get("CI") == "true":
        pytest.fail(f"CI has no Docker engine: {problem}")
    if problem:
        pytest.skip(f"no Docker engine: {problem}")


@pytest.fixture(scope="module")
def up(engine: None) -> Iterator[Compose]:  # noqa: ARG001 - skips without an engine
    """The started project; its robot may still be driving."""
    compose = Compose()
    compose("down", "--volumes", "--remove-orphans")
    compose("build")
    compose("up", "--detach", "--no-build")
    yield compose
    compose("down", "--volumes", "--remove-orphans")
