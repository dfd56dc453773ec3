"""Fixtures that make executors and close them."""

import importlib
from collections.abc import Callable, Iterator

import pytest

from offboard.cloud_server.executors import EXECUTORS, Executor
from tests.executor_tasks import MODULE, ON_THIS_COMPUTER, WAIT_S


@pytest.fixture(scope="module")
def module(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The name of a module with tasks, which can be imported."""
    folder = tmp_path_factory.mktemp("tasks")
    (folder / "executor_tasks.py").write_text(MODULE)
    patch = pytest.MonkeyPatch()
    patch.syspath_prepend(folder)
    importlib.import_module("executor_tasks")
    yield "executor_tasks"
    patch.undo()


@pytest.fixture
def make(module: str) -> Iterator[Callable[..., Executor]]:
    """Makes warm executors."""
    made: list[Executor] = []

    def start(
        name: str,
        workers: int = 1,
        blob_bytes_max: int = 1_000_000,
        changed: Callable[[str], None] = lambda _: None,
    ) -> Executor:
        executor = EXECUTORS[name](workers, [module], blob_bytes_max)
        made.append(executor)
        executor.warm(changed).result(WAIT_S)
        return executor

    yield start
    for executor in made:
        executor.close()


@pytest.fixture(scope="module", params=ON_THIS_COMPUTER)
def executor(request: pytest.FixtureRequest, module: str) -> Iterator[Executor]:
    """One warm executor of each kind, with two workers."""
    executor = EXECUTORS[request.param](2, [module], 1_000_000)
    executor.warm().result(WAIT_S)
    yield executor
    executor.close()
