"""Fixtures of the tests of keys and tokens: the keys, a server and a robot."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from benchmarks.keyring import Keys
from offboard.robot_client.offloader import Offloader
from tests.curves import Served


@pytest.fixture
def keys(tmp_path: Path) -> Keys:
    return Keys(tmp_path)


@pytest.fixture
def serve() -> Iterator[Callable[..., Served]]:
    """Factory: a server process with these keys and flags."""
    with ExitStack() as stack:

        def start(keys: Keys | None, *flags: str) -> Served:
            served = Served(*(["--keys", str(keys.server)] if keys else []), *flags)
            stack.callback(served.close)
            return served

        yield start


@pytest.fixture
def robot() -> Iterator[Callable[..., Offloader]]:
    """Factory: a robot that sends every task to the cloud, returned before it is connected."""
    with ExitStack() as stack:

        def connect(endpoint: str, keys: Path | None, **options: Any) -> Offloader:
            return stack.enter_context(Offloader.connect(endpoint, policy="cloud", keys=keys, **options))

        yield connect
