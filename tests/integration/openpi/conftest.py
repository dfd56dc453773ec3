"""Fixtures of the tests of policy servers: third-party software in an environment of its own."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.integration.openpi import environment

HERE = Path(__file__).parent
END_S = 10.0


@pytest.fixture(scope="session")
def third_party() -> Path:
    """The Python of the environment with `openpi-client` and `policy-websocket`."""
    try:
        return environment.python()
    except environment.CannotBuildError as error:
        if os.environ.get("CI") == "true":
            raise
        pytest.skip(f"no environment with openpi-client: {error}")


class PolicyServer:
    """A server of `policy-websocket` in a process, which can be killed and started again."""

    def __init__(self, python: Path, log: Path) -> None:
        with socket.create_server(("127.0.0.1", 0)) as unused:
            self._port = unused.getsockname()[1]
        self.endpoint = f"ws://127.0.0.1:{self._port}"
        self._python, self._log = python, log
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        with self._log.open("ab") as log:
            command = [str(self._python), str(HERE / "serve.py"), str(self._port)]
            self._process = subprocess.Popen(command, stdout=log, stderr=log)

    def signal(self, number: signal.Signals) -> None:
        assert self._process is not None
        self._process.send_signal(number)

    def kill(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait(END_S)


@pytest.fixture
def policy_server(third_party: Path, tmp_path: Path) -> Iterator[Callable[[], PolicyServer]]:
    """Factory: a server of `policy-websocket` that runs."""
    with contextlib.ExitStack() as stack:

        def start() -> PolicyServer:
            server = PolicyServer(third_party, tmp_path / "server.log")
            stack.callback(server.kill)
            server.start()
            return server

        yield start


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as unused:
        return int(unused.getsockname()[1])


class GrootServer:
    """A server in a process, which can be killed and started again."""

    def __init__(self, dialect: str, token: str | None) -> None:
        self.port = free_port()
        self.endpoint = f"groot://127.0.0.1:{self.port}"
        self._command = [
            sys.executable,
            str(HERE / "groot_server.py"),
            str(self.port),
            dialect,
            *([token] if token else []),
        ]
        self.start()

    def start(self) -> None:
        self._process = subprocess.Popen(self._command)

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()

    def signal(self, number: signal.Signals) -> None:
        self._process.send_signal(number)


@pytest.fixture
def groot() -> Iterator[Callable[..., GrootServer]]:
    """Factory: a running server that speaks one of the encodings."""
    made: list[GrootServer] = []

    def start(dialect: str = "npy", token: str | None = None) -> GrootServer:
        made.append(GrootServer(dialect, token))
        return made[-1]

    yield start
    for one in made:
        one.kill()
