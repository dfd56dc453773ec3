"""Fixtures that make Ray clusters and executors on them, and end both."""

from collections.abc import Callable, Iterator
from typing import Any

import pytest

from offboard.cloud_server.executors import EXECUTORS, Executor
from offboard.cloud_server.executors.worker_pool import MEMORY_BYTES_MAX
from tests.integration.executors.conftest import module
from tests.ray.clusters import RayNodes
from tests.ray.handles import StandIn

__all__ = ["module"]

START_S = 60.0
BLOB_BYTES = 1_000_000


@pytest.fixture(scope="module")
def nodes() -> Iterator[RayNodes]:
    """A cluster with two nodes for the tests of one file."""
    pytest.importorskip("ray", reason="Ray is not installed here: make ray runs this test")
    cluster = RayNodes()
    yield cluster
    cluster.close()


@pytest.fixture
def fresh() -> Iterator[Callable[..., RayNodes]]:
    """Makes clusters that one test may break."""
    pytest.importorskip("ray", reason="Ray is not installed here: make ray runs this test")
    made: list[RayNodes] = []

    def start(count: int = 0, **head: Any) -> RayNodes:
        made.append(RayNodes(count, **head))
        return made[-1]

    yield start
    for one in made:
        one.close()


@pytest.fixture(scope="module")
def connect(module: str) -> Iterator[Callable[..., Executor]]:
    """Makes warm executors, one after the other: a process is connected to one cluster at a time."""
    made: list[Executor] = []

    def start(
        cluster: RayNodes,
        workers: int = 2,
        changed: Callable[[str], None] = lambda _: None,
        modules: tuple[str, ...] = (module,),
        **resources: float,
    ) -> Executor:
        for one in made:
            one.close()
        place = {"ray_address": cluster.address, "ray_resources": resources}
        made.append(EXECUTORS["ray"](workers, modules, BLOB_BYTES, MEMORY_BYTES_MAX, **place))
        made[-1].warm(changed).result(START_S)
        return made[-1]

    yield start
    for one in made:
        one.close()


@pytest.fixture(scope="module")
def executor(nodes: RayNodes, connect: Callable[..., Executor]) -> Executor:
    """One warm executor with a worker on each of the two nodes."""
    return connect(nodes)


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> StandIn:
    """A cluster whose actors are in this process."""
    pytest.importorskip("ray", reason="Ray is not installed here: make ray runs this test")
    return StandIn(monkeypatch)
