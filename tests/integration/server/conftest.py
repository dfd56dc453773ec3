"""Fixtures that start servers and connect peers."""

import importlib
import os
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from tests.integration.server.peers import MODULE, Peer, Running


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The folder of the module `served_tasks`."""
    folder = tmp_path_factory.mktemp("tasks")
    (folder / "served_tasks.py").write_text(MODULE)
    patch = pytest.MonkeyPatch()
    patch.syspath_prepend(folder)
    importlib.import_module("served_tasks")
    yield folder
    patch.undo()


@pytest.fixture
def serve(folder: Path) -> Iterator[Callable[..., Running]]:
    """Starts servers in threads of this process."""
    with ExitStack() as stack:

        def start(*args: Any, **limits: Any) -> Running:
            running = Running(*args, **limits)
            stack.callback(running.close)
            return running

        assert folder
        yield start


@pytest.fixture
def join() -> Iterator[Callable[[str], Peer]]:
    """Connects peers to an endpoint."""
    with ExitStack() as stack:

        def connect(endpoint: str) -> Peer:
            peer = Peer(endpoint)
            stack.callback(peer.close)
            return peer

        yield connect


@pytest.fixture
def pipe(tmp_path: Path) -> Iterator[Path]:
    """A named pipe for `served_pipe`. At the end it lets tasks go that still wait for it."""
    path = tmp_path / "pipe"
    os.mkfifo(path)
    yield path
    while True:
        try:
            os.close(os.open(path, os.O_WRONLY | os.O_NONBLOCK))
        except OSError:
            return
        time.sleep(0.01)
