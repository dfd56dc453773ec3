"""Fixtures that start the node and a peer in an environment with rclpy, and the server behind a relay."""

import contextlib
import json
import os
import queue
import secrets
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from offboard.common.planning.map_files import read_map
from offboard.common.planning.maps import GridMap

ROOT = Path(__file__).parents[2]
ENVIRONMENTS = ROOT / ".cache"
RELEASES = ("kilted", "jazzy")
PLANNER = {"tasks": "offboard.common.planning.planner", "workers": 1}
ANSWER_S = 120.0


class Process:
    """A process of an environment with ROS, which answers JSON lines if it is a peer."""

    def __init__(self, python: Path, arguments: list[str], log: Path, domain: int) -> None:
        self._log = log
        environ = os.environ | {"ROS_DOMAIN_ID": str(domain), "PYTHONPATH": str(ROOT)}
        environ["NUMBA_CACHE_DIR"] = str(python.parents[1] / "numba")  # each version of numba has its own
        environ |= {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "PYTHONUNBUFFERED": "1"}
        self._err = log.open("a")
        self.process = subprocess.Popen(
            [str(python), *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._err,
            text=True,
            env=environ,
            cwd=ROOT,
        )
        self._lines: queue.Queue[str] = queue.Queue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self._lines.put(line)

    def do(self, name: str, **arguments: Any) -> Any:
        """Send a command, and return its answer."""
        self.send(name, **arguments)
        return self.answer()

    def send(self, name: str, **arguments: Any) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps({"do": name, **arguments}) + "\n")
        self.process.stdin.flush()

    def answer(self) -> Any:
        try:
            return json.loads(self._lines.get(timeout=ANSWER_S))
        except queue.Empty:
            raise AssertionError(f"no answer: {self.log()}") from None

    def log(self) -> str:
        return self._log.read_text()

    def close(self) -> None:
        self.process.terminate()
        try:
            self.process.wait(10.0)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self._reader.join(10.0)
        for file in (self.process.stdin, self.process.stdout, self._err):
            assert file is not None
            with contextlib.suppress(BrokenPipeError):
                file.close()


def python_of(release: str) -> Path:
    """The Python of a release; the test is skipped if `make ros2` has not built it."""
    python = ENVIRONMENTS / f"ros2-{release}" / "bin" / "python"
    if not python.exists():
        pytest.skip(f"no environment for {release}: make ros2 builds it")
    return python


@pytest.fixture
def domain() -> int:
    """A DDS domain of its own, so that tests do not hear each other."""
    return 1 + secrets.randbelow(100)


@pytest.fixture
def start(tmp_path: Path, domain: int) -> Iterator[Callable[..., Process]]:
    """Factory: a process of a release, in the domain of this test."""
    made: list[Process] = []

    def factory(release: str, *arguments: str) -> Process:
        log = tmp_path / f"process-{len(made)}.log"
        made.append(Process(python_of(release), list(arguments), log, domain))
        return made[-1]

    yield factory
    for process in made:
        process.close()


@pytest.fixture
def node(start: Callable[..., Process]) -> Callable[..., Process]:
    """Factory: a planner node; flags of Offboard first, parameters by name."""

    def factory(release: str, *flags: str, **parameters: Any) -> Process:
        return start(
            release, "-m", "offboard.robot_client", "ros2", *flags, "--ros-args", *assigned(parameters)
        )

    return factory


@pytest.fixture
def bridge(tmp_path: Path, domain: int) -> Iterator[Callable[..., Process]]:
    """Factory: a bridge in the environment of the tests, which has no ROS."""
    pytest.importorskip("cyclonedds")
    made: list[Process] = []

    def factory(*flags: str, **parameters: Any) -> Process:
        log = tmp_path / f"bridge-{len(made)}.log"
        arguments = [
            "-m",
            "offboard.robot_client",
            "ros2",
            "--bridge",
            *flags,
            "--ros-args",
            *assigned(parameters),
        ]
        made.append(Process(Path(sys.executable), arguments, log, domain))
        return made[-1]

    yield factory
    for process in made:
        process.close()


def assigned(parameters: dict[str, Any]) -> list[str]:
    """The arguments that set these parameters; __ stands for a dot."""
    texts = {name.replace("__", "."): str(value).lower() for name, value in parameters.items()}
    return [part for name, text in texts.items() for part in ("-p", f"{name}:={text}")]


@pytest.fixture
def peer(start: Callable[..., Process], tmp_path: Path) -> Callable[..., Process]:
    """Factory: a client, which has published this map."""

    def factory(release: str, grid: GridMap | None = None) -> Process:
        made = start(release, "tests/ros2/peer.py")
        if grid is not None:
            made.do(
                "map", file=str(raw_map(grid, tmp_path)), resolution=grid.resolution, origin=grid.origin[:2]
            )
        return made

    return factory


def raw_map(grid: GridMap, folder: Path) -> Path:
    """A file that the peer can read without a library."""
    path = folder / f"map-{grid.cells.shape[1]}x{grid.cells.shape[0]}.raw"
    height, width = grid.cells.shape
    path.write_bytes(f"{width} {height}\n".encode() + grid.cells.tobytes())
    return path


@pytest.fixture(scope="session", params=["willow-full-0.05", "depot"])
def named_grid(request: pytest.FixtureRequest) -> GridMap:
    return read_map(ROOT / "maps" / f"{request.param}.yaml")


@pytest.fixture(scope="session")
def depot() -> GridMap:
    return read_map(ROOT / "maps" / "depot.yaml")
