"""The runner of the robot's own computer: threads of this process."""

import os
import threading
from collections.abc import Iterator

import pytest

from offboard.common.errors import OffloadError, Overtaken, Unwanted
from offboard.common.tasks import Task, kind_of, task
from offboard.common.wanted import check_wanted
from offboard.robot_client.sites import onboard
from offboard.robot_client.sites.onboard import ASIDE_MAX, ASIDE_NICE, OnboardRunner
from offboard.robot_client.sites.own_cpu import LOADED_SLOWER, OWN_CPU

WAIT_S = 5.0


class Gate:
    """Holds `held_back` until it is opened."""

    def __init__(self) -> None:
        self.open, self.stopped = threading.Event(), threading.Event()
        self.begun: list[int] = []
        self.threads: list[int] = []


gate = Gate()


@task("held_back", size=float)
def held_back(number: int) -> int:
    gate.begun.append(number)
    gate.threads.append(threading.get_native_id())
    assert gate.open.wait(WAIT_S)
    return number


@task("looking", size=float)
def looking(number: int) -> int:
    gate.begun.append(number)
    try:
        while not gate.open.wait(0.001):
            check_wanted()
    except Unwanted:
        gate.stopped.set()
        raise
    return number


@task("at_once", size=float)
def at_once(number: int) -> int:
    return number


def call(number: int, function: object = held_back) -> Task:
    return Task(kind_of(function), (number,), float(number))  # type: ignore[arg-type]


@pytest.fixture
def runner() -> Iterator[OnboardRunner]:
    gate.__init__()  # type: ignore[misc]
    one = OnboardRunner()
    yield one
    gate.open.set()
    one.close()


def until_begun(count: int) -> None:
    for _ in range(500):
        if len(gate.begun) == count:
            return
        threading.Event().wait(0.01)
    raise AssertionError(f"{gate.begun} has begun")


def test_a_run_that_is_cancelled_makes_room_at_once(runner: OnboardRunner) -> None:
    """Its future ends as overtaken, it goes on at a low priority, and the next task does not wait for it."""
    first = call(1)
    future = runner.submit(first, 1.0)
    until_begun(1)
    runner.cancel(first)
    given_up = future.result(0)
    assert isinstance(given_up.failure, Overtaken)
    assert given_up.censored
    assert given_up.started
    assert runner.submit(call(2, at_once), 1.0).result(WAIT_S).value == 2
    own = os.getpriority(os.PRIO_PROCESS, 0)
    assert os.getpriority(os.PRIO_PROCESS, gate.threads[0]) == max(ASIDE_NICE, own)


def test_a_run_that_looks_whether_it_is_wanted_stops(runner: OnboardRunner) -> None:
    """And one that comes after it is wanted."""
    first = call(1, looking)
    future = runner.submit(first, 1.0)
    until_begun(1)
    runner.cancel(first)
    assert isinstance(future.result(0).failure, Overtaken)
    assert gate.stopped.wait(WAIT_S)
    gate.open.set()
    assert runner.submit(call(2, looking), 1.0).result(WAIT_S).value == 2


def test_so_many_go_on_aside_and_no_more(runner: OnboardRunner) -> None:
    """One more than ASIDE_MAX cannot be cancelled: it keeps its place until it ends."""
    for number in range(ASIDE_MAX):
        one = call(number)
        future = runner.submit(one, 1.0)
        until_begun(number + 1)
        runner.cancel(one)
        assert future.done()
    last = call(ASIDE_MAX)
    future = runner.submit(last, 1.0)
    until_begun(ASIDE_MAX + 1)
    runner.cancel(last)
    behind = runner.submit(call(9, at_once), 1.0)
    assert not future.done()
    assert not behind.done()
    gate.open.set()
    assert (future.result(WAIT_S).value, behind.result(WAIT_S).value) == (ASIDE_MAX, 9)


def test_a_task_that_waits_is_not_begun_once_it_is_cancelled(runner: OnboardRunner) -> None:
    """It ends as never started; those behind it take its place."""
    runner.submit(call(1), 1.0)
    until_begun(1)
    second, third = call(2), call(3)
    waits, follows = runner.submit(second, 1.0), runner.submit(third, 1.0)
    runner.cancel(second)
    assert not waits.result(0).started
    gate.open.set()
    assert follows.result(WAIT_S).value == 3
    assert gate.begun == [1, 3]


def test_what_is_unknown_or_over_can_be_cancelled(runner: OnboardRunner) -> None:
    one = call(1, at_once)
    assert runner.submit(one, 1.0).result(WAIT_S).value == 1
    runner.cancel(one)
    runner.cancel(call(2))


def test_closing_ends_what_waits(runner: OnboardRunner) -> None:
    """What runs comes to its end, what waits is cancelled, and nothing more is taken."""
    runs, waits = runner.submit(call(1), 1.0), runner.submit(call(2), 1.0)
    until_begun(1)
    runner.close()
    runner.close()
    assert waits.cancelled()
    with pytest.raises(OffloadError, match="the onboard runner is closed"):
        runner.submit(call(3), 1.0)
    gate.open.set()
    assert runs.result(WAIT_S).value == 1


@pytest.mark.usefixtures("runner")
def test_closing_leaves_no_thread_that_can_end() -> None:
    """One that ended with the process took it down, now and then (SIGABRT); those set aside count too."""
    for _ in range(20):
        gate.__init__()  # type: ignore[misc]
        one, before = OnboardRunner(2), set(threading.enumerate())
        aside, plain = call(1), [one.submit(call(number, at_once), 1.0) for number in range(4)]
        one.submit(aside, 1.0)
        until_begun(1)
        one.cancel(aside)
        assert [future.result(WAIT_S).ok for future in plain] == [True] * 4
        gate.open.set()
        one.close()
        assert {thread.name for thread in set(threading.enumerate()) - before} <= {"load"}


def test_closing_does_not_wait_for_ever(runner: OnboardRunner, monkeypatch: pytest.MonkeyPatch) -> None:
    """A task that does not end is left behind."""
    monkeypatch.setattr(onboard, "CLOSE_WAIT_S", 0.05)
    runs = runner.submit(call(1), 1.0)
    until_begun(1)
    runner.close()
    assert not runs.done()


@pytest.mark.usefixtures("runner")
def test_so_many_workers_run_at_a_time() -> None:
    """And each task once."""
    many = OnboardRunner(3)
    futures = [many.submit(call(number), 1.0) for number in range(6)]
    until_begun(3)
    gate.open.set()
    assert [future.result(WAIT_S).value for future in futures] == list(range(6))
    assert sorted(gate.begun) == list(range(6))
    many.close()


def test_a_load_is_forgotten_with_the_runner_that_read_it(
    runner: OnboardRunner, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While it lasts pauses are longer, in the whole process; the next runner begins without."""
    monkeypatch.setattr(runner._load, "latest", lambda: (0.9, 1.0))
    runner.condition()
    assert OWN_CPU.pause_s(1.0) == LOADED_SLOWER
    runner.close()
    assert OWN_CPU.pause_s(1.0) == 1.0


def test_a_load_is_over_when_none_is_read(runner: OnboardRunner, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever read it: a look that finds what it found before tells too."""
    monkeypatch.setattr(runner._load, "latest", lambda: (0.0, 1.0))
    monkeypatch.setattr(OWN_CPU, "loaded", True)
    runner.condition()
    assert OWN_CPU.pause_s(1.0) == 1.0
