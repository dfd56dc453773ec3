"""The system has no free thread for a moment: every call is answered, and nothing is broken afterwards."""

import asyncio
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from offboard import Offloader
from offboard.common.errors import OffloadError
from offboard.common.load import Load, LoadWatch
from offboard.common.tasks import Task, kind_of, task
from offboard.robot_client.cloud.cloud_runner import CloudRunner
from offboard.robot_client.sites.onboard import OnboardRunner
from offboard.robot_client.sites.runner import ONBOARD

WAIT_S = 5.0

threads: list[str] = []
hold, begun = threading.Event(), threading.Event()


@task("plus_one", size=float)
def plus_one(number: int) -> int:
    threads.append(threading.current_thread().name)
    return number + 1


@task("plus_model", size=float, setup=lambda: 10)
def plus_model(model: int, number: int) -> int:
    return model + number


@task("held_to_block", size=float)
def held(number: int) -> int:
    begun.set()
    assert hold.wait(WAIT_S)
    return number


@pytest.fixture
def no_thread(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[], Any]]:
    """A context in which no thread can be started, as when `ulimit -u` is reached."""
    threads.clear()
    hold.clear()
    begun.clear()
    # What `Thread.start` calls; its name depends on the version of Python.
    names = [name for name in ("_start_new_thread", "_start_joinable_thread") if hasattr(threading, name)]

    def refuse(*_: Any, **__: Any) -> None:
        raise RuntimeError("can't start new thread")

    @contextmanager
    def context() -> Iterator[None]:
        with monkeypatch.context() as patch:
            for name in names:
                patch.setattr(threading, name, refuse)
            yield

    yield context
    hold.set()


def answer(offload: Offloader, way: str) -> int:
    if way == "asyncio":
        return asyncio.run(offload.run(plus_one, 1))
    if way == "map":
        return offload.map(plus_one, [1, 1, 1])[2]
    return offload(plus_model, 1) - 9 if way == "setup" else offload(plus_one, 1)


@pytest.mark.parametrize("way", ["call", "map", "asyncio", "setup"])
def test_a_call_is_answered_without_a_free_thread(no_thread: Callable[[], Any], way: str) -> None:
    """The thread of the caller runs the task. Once there are threads again, they run the tasks."""
    with Offloader.connect() as offload:
        for _ in range(2):
            with no_thread():
                assert answer(offload, way) == 2
        assert offload(plus_one, 1) == 2
        assert threads[-1] == ONBOARD
        assert set(threads[:-1]) <= {threading.current_thread().name}
        assert answer(offload, way) == 2


def test_a_setup_is_made_without_a_free_thread(no_thread: Callable[[], Any]) -> None:
    """`wait_for_sites` runs it in the thread of the caller."""
    with Offloader.connect() as offload:
        with no_thread():
            assert offload.wait_for_sites(plus_model, WAIT_S) == {}
        assert offload(plus_model, 1) == 11


def test_a_busy_worker_is_waited_for_if_no_other_can_be_started(no_thread: Callable[[], Any]) -> None:
    """With one of two workers, the second task waits; later tasks start the second worker."""
    runner = OnboardRunner(2)
    first = runner.submit(Task(kind_of(held), (1,), 1.0), 1.0)
    assert begun.wait(WAIT_S)
    with no_thread():
        second = runner.submit(Task(kind_of(plus_one), (1,), 1.0), 1.0)
    assert not second.done()
    assert runner.submit(Task(kind_of(plus_one), (2,), 1.0), 1.0).result(WAIT_S).value == 3
    assert second.result(WAIT_S).value == 2
    hold.set()
    assert first.result(WAIT_S).value == 1
    runner.close()


def test_a_run_is_not_cancelled_if_no_thread_can_take_its_place(no_thread: Callable[[], Any]) -> None:
    """It goes on, keeps its place, and the next task follows it."""
    runner = OnboardRunner()
    one = Task(kind_of(held), (1,), 1.0)
    first = runner.submit(one, 1.0)
    assert begun.wait(WAIT_S)
    with no_thread():
        runner.cancel(one)
        second = runner.submit(Task(kind_of(plus_one), (1,), 1.0), 1.0)
    assert not first.done()
    hold.set()
    assert (first.result(WAIT_S).value, second.result(WAIT_S).value) == (1, 2)
    runner.close()


def test_the_load_is_read_without_a_free_thread(no_thread: Callable[[], Any]) -> None:
    """The thread that asks reads it, and a later reading starts the thread, on every version of Python."""
    watch = LoadWatch(Load(Path("/proc/self")), 60.0)
    for _ in range(2):
        with no_thread():
            load, capacity = watch.latest()
        assert 0 <= load <= 1
        assert 0 < capacity <= 1
    before = threading.active_count()
    watch.latest()
    assert threading.active_count() == before + 1
    watch.close()


def test_a_server_that_gets_no_thread_is_an_error_and_leaves_nothing_open(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """If the last thread is taken after the check for room, it is an OffloadError, as without room."""

    start = threading.Thread.start

    def refuse(thread: threading.Thread) -> None:
        if thread.name == "site-gpu":
            raise RuntimeError("can't start new thread")
        start(thread)

    monkeypatch.setattr(threading.Thread, "start", refuse)
    files = []
    for _ in range(3):
        with pytest.raises(OffloadError, match="gpu: can't start new thread"):
            CloudRunner("tcp://127.0.0.1:5555", site="gpu")
        files.append(len(list(Path("/proc/self/fd").iterdir())))
    assert files[0] == files[1] == files[2]  # the first one also opens what libzmq keeps
