"""Fixtures that start planner nodes, bridges and peers in processes of their own.

Nodes and peers with rclpy run in the environments that `make ros2` builds. The bridge and its peer run in the
environment of the tests, which has no ROS.
"""

import json
import os
import queue
import secrets
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from offboard.common.planning.map_files import read_map
from offboard.common.planning.maps import GridMap

ROOT = Path(__file__).parents[2]
RELEASES = ("kilted", "jazzy")
DDS = "cyclonedds"  # a peer without ROS
PLANNER = {"tasks": "offboard.common.planning.planner", "workers": 1}
ANSWER_S = 120.0
END_S = 10.0
WORKER, WORKERS_MAX = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0")[2:]), 10
ACTION = "compute_path_to_pose"
# Where DDS looks for others: everywhere in a network of its own, else only on this computer.
RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
NETWORK = os.environ.get(RANGE, "LOCALHOST")


class Process:
    """A process that answers JSON lines if it is a peer."""

    def __init__(self, command: Sequence[str | Path], log: Path, environ: dict[str, str]) -> None:
        self._log = log
        self._err = log.open("a")
        self.process = subprocess.Popen(
            list(map(str, command)),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._err,
            text=True,
            env=os.environ
            | {"PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1", "PYTHONFAULTHANDLER": "1"}
            | environ,
            cwd=ROOT,
        )
        self._lines: queue.Queue[str] = queue.Queue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self._lines.put(line)
        self._lines.put("")

    def do(self, name: str, **arguments: Any) -> Any:
        """Send a command, and return its answer."""
        self.send(name, **arguments)
        return self.answer()

    def send(self, name: str, **arguments: Any) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps({"do": name, **arguments}) + "\n")
        self.process.stdin.flush()

    def answer(self) -> Any:
        line = self._lines.get(timeout=ANSWER_S)
        assert line, f"the process ended: {self.log()}"
        return json.loads(line)

    def log(self) -> str:
        return self._log.read_text()

    def terminate(self) -> int:
        """Ask the process to end; returns its exit code. If it hangs, its log then says where."""
        self.process.terminate()
        try:
            return self.process.wait(END_S)
        except subprocess.TimeoutExpired:
            self.process.send_signal(signal.SIGABRT)
            return self.process.wait()

    def close(self) -> int:
        """End the process; returns its exit code."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.close()  # the end of its commands ends a peer
        code = self.terminate()
        self._reader.join(END_S)
        self.process.stdout.close()
        self._err.close()
        return code


def python_of(release: str) -> Path:
    """The Python of a release; the test is skipped if `make ros2` has not built it."""
    python = ROOT / ".cache" / f"ros2-{release}" / "bin" / "python"
    if not python.exists():
        pytest.skip(f"no environment for {release}: make ros2 builds it")
    return python


@pytest.fixture
def reach() -> str:
    """Where DDS looks for others in this test."""
    return NETWORK


@pytest.fixture
def start(tmp_path: Path, reach: str) -> Iterator[Callable[..., Process]]:
    """Factory: a process with the Python of a release, or with that of the tests for DDS.

    A test has a DDS domain of its own, so that tests do not hear each other.
    """
    made: list[Process] = []
    number = 1 + WORKER + WORKERS_MAX * secrets.randbelow(10)
    domain = {"ROS_DOMAIN_ID": str(number), RANGE: reach}

    def factory(where: str, *arguments: str) -> Process:
        python, environ = Path(sys.executable), domain
        if where == DDS:
            pytest.importorskip("cyclonedds")
        else:
            python = python_of(where)
            environ = domain | {"NUMBA_CACHE_DIR": str(python.parents[1] / "numba")}  # of its own numba
        made.append(Process([python, *arguments], tmp_path / f"process-{len(made)}.log", environ))
        return made[-1]

    yield factory
    codes = [process.close() for process in reversed(made)]
    assert codes == [0] * len(codes), [process.log() for process in made]


@pytest.fixture
def node(start: Callable[..., Process]) -> Callable[..., Process]:
    """Factory: a planner node, or a bridge for DDS; with flags of Offboard, and parameters by name."""

    def factory(where: str, *flags: str, **parameters: Any) -> Process:
        chosen = ("--bridge",) if where == DDS else ()
        command = ("-m", "offboard.robot_client", "ros2", *chosen, *flags)
        return start(where, *command, "--ros-args", *assigned(parameters))

    return factory


@pytest.fixture
def topic_node(start: Callable[..., Process], node: Callable[..., Process]) -> Callable[..., Process]:
    """Factory: a planner node without nav2_msgs, which serves topics only; for DDS a bridge."""
    hidden = "import sys; sys.modules['nav2_msgs'] = None; from offboard.robot_client.__main__ import main; "

    def factory(where: str, *flags: str, **parameters: Any) -> Process:
        if where == DDS:
            return node(DDS, *flags, **parameters)
        command = ["ros2", *flags, "--ros-args", *assigned(parameters)]
        return start(where, "-c", f"{hidden}sys.exit(main({command}))")

    return factory


def assigned(parameters: dict[str, Any]) -> list[str]:
    """The arguments that set these parameters; __ stands for a dot."""
    texts = {name.replace("__", "."): str(value).lower() for name, value in parameters.items()}
    return [part for name, text in texts.items() for part in ("-p", f"{name}:={text}")]


@pytest.fixture
def peer(start: Callable[..., Process], tmp_path: Path) -> Callable[..., Process]:
    """Factory: a peer of a release, or one without ROS, which has published this map."""

    def factory(where: str, grid: GridMap | None = None, action: str = ACTION) -> Process:
        made = start(where, *(["tests/ros2/dds_peer.py"] if where == DDS else ["tests/ros2/peer.py", action]))
        if grid is not None:
            publish_map(made, grid, tmp_path)
        return made

    return factory


def publish_map(peer: Process, grid: GridMap, folder: Path) -> None:
    """Let a peer publish a map, from a file that it can read without a library."""
    height, width = grid.cells.shape
    path = folder / f"map-{width}x{height}.raw"
    path.write_bytes(f"{width} {height}\n".encode() + grid.cells.tobytes())
    peer.do("map", file=str(path), resolution=grid.resolution, origin=grid.origin[:2])


@pytest.fixture(scope="session")
def willow() -> GridMap:
    return read_map(ROOT / "maps" / "willow-full-0.05.yaml")


@pytest.fixture(scope="session")
def depot() -> GridMap:
    return read_map(ROOT / "maps" / "depot.yaml")
