"""The onboard runner: queue, cancelled runs, closing, and the load of the robot."""

import os
import signal
import sys
import threading
import warnings
from collections.abc import Iterator
from concurrent.futures import CancelledError, Future

import pytest

from offboard.common.errors import OffloadError, Overtaken, Unwanted
from offboard.common.task_call import check_wanted
from offboard.common.tasks import Task, kind_of, task
from offboard.robot_client.sites import onboard
from offboard.robot_client.sites.onboard import ABANDONED_MAX, ABANDONED_NICE, OnboardRunner
from offboard.robot_client.sites.waiting import SystemClock

WAIT_S = 5.0


class Gate:
    """Holds the tasks of these tests until a test opens it, and knows which have begun."""

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


@task("forking", size=float)
def forking(status: int) -> int:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # Python 3.12 warns, because there are threads
        child = os.fork()
    if child == 0:
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(int(WAIT_S))  # ends a copy that does not end by itself
        if status:
            sys.exit(status)
    return child


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
    raise AssertionError(f"{count} tasks should have begun, not {gate.begun}")


def test_a_cancelled_run_makes_room_at_once(runner: OnboardRunner) -> None:
    """Its future ends as overtaken, the run goes on at a low priority, and the next task starts at once."""
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
    assert os.getpriority(os.PRIO_PROCESS, gate.threads[0]) == max(ABANDONED_NICE, own)


def test_a_cancelled_run_stops_if_it_checks_for_that(runner: OnboardRunner) -> None:
    """`check_wanted` ends the cancelled run, and does not end the next one."""
    first = call(1, looking)
    future = runner.submit(first, 1.0)
    until_begun(1)
    runner.cancel(first)
    assert isinstance(future.result(0).failure, Overtaken)
    assert gate.stopped.wait(WAIT_S)
    gate.open.set()
    assert runner.submit(call(2, looking), 1.0).result(WAIT_S).value == 2


def test_the_number_of_abandoned_runs_is_bounded(runner: OnboardRunner) -> None:
    """Past ABANDONED_MAX abandoned runs, a run cannot be cancelled: it keeps its place until it ends."""
    for number in range(ABANDONED_MAX):
        one = call(number)
        future = runner.submit(one, 1.0)
        until_begun(number + 1)
        runner.cancel(one)
        assert future.done()
    last = call(ABANDONED_MAX)
    future = runner.submit(last, 1.0)
    until_begun(ABANDONED_MAX + 1)
    runner.cancel(last)
    behind = runner.submit(call(9, at_once), 1.0)
    assert not future.done()
    assert not behind.done()
    gate.open.set()
    assert (future.result(WAIT_S).value, behind.result(WAIT_S).value) == (ABANDONED_MAX, 9)


def test_a_cancelled_task_in_the_queue_never_runs(runner: OnboardRunner) -> None:
    """It ends as never started, and the next task in the queue takes its place."""
    runner.submit(call(1), 1.0)
    until_begun(1)
    second, third = call(2), call(3)
    waits, follows = runner.submit(second, 1.0), runner.submit(third, 1.0)
    runner.cancel(second)
    assert not waits.result(0).started
    gate.open.set()
    assert follows.result(WAIT_S).value == 3
    assert gate.begun == [1, 3]


def test_cancelling_an_unknown_or_finished_task_does_nothing(runner: OnboardRunner) -> None:
    """Neither raises."""
    one = call(1, at_once)
    assert runner.submit(one, 1.0).result(WAIT_S).value == 1
    runner.cancel(one)
    runner.cancel(call(2))


def test_closing_cancels_the_queue(runner: OnboardRunner) -> None:
    """The task that runs ends, those in the queue are cancelled, and new tasks are refused."""
    runs, waits = runner.submit(call(1), 1.0), runner.submit(call(2), 1.0)
    until_begun(1)
    closing = threading.Thread(target=runner.close)
    closing.start()
    with pytest.raises(CancelledError):
        waits.result(WAIT_S)
    with pytest.raises(OffloadError, match="the onboard runner is closed"):
        runner.submit(call(3), 1.0)
    gate.open.set()
    assert runs.result(WAIT_S).value == 1
    closing.join(WAIT_S)
    assert not closing.is_alive()
    runner.close()


def test_closing_ends_a_wait_for_several_futures(
    runner: OnboardRunner, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`Offloader.map` waits for a task in the queue, and at the same time for its call to another site."""
    monkeypatch.setattr(onboard, "CLOSE_WAIT_S", 0.05)
    runner.submit(call(1), 1.0)
    queued, other = runner.submit(call(2), 1.0), Future[str]()
    until_begun(1)
    waiting = threading.Thread(target=SystemClock().wait, args=([queued, other],), daemon=True)
    waiting.start()
    runner.close()
    waiting.join(WAIT_S)
    assert not waiting.is_alive()


@pytest.mark.usefixtures("runner")
def test_after_closing_no_thread_is_left_that_could_end() -> None:
    """A thread that ends together with the process may abort it (SIGABRT); abandoned runs count too."""
    for _ in range(20):
        gate.__init__()  # type: ignore[misc]
        one, before = OnboardRunner(2), set(threading.enumerate())
        abandoned, plain = call(1), [one.submit(call(number, at_once), 1.0) for number in range(4)]
        one.submit(abandoned, 1.0)
        until_begun(1)
        one.cancel(abandoned)
        assert [future.result(WAIT_S).ok for future in plain] == [True] * 4
        gate.open.set()
        one.close()
        assert {thread.name for thread in set(threading.enumerate()) - before} <= {"load"}


def test_closing_has_a_limit(
    runner: OnboardRunner, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A task that does not end within CLOSE_WAIT_S is left running, and nobody waits for it any more."""
    monkeypatch.setattr(onboard, "CLOSE_WAIT_S", 0.05)
    runs = runner.submit(call(1), 1.0)
    until_begun(1)
    runner.close()
    assert runs.cancelled()
    assert "1 of its threads still run a task 0.05 s after the close" in caplog.text


def test_closing_waits_for_abandoned_runs(runner: OnboardRunner) -> None:
    """They may run native code, which must not go on while the process ends."""
    one = call(1)
    runner.submit(one, 1.0)
    until_begun(1)
    runner.cancel(one)
    closing = threading.Thread(target=runner.close)
    closing.start()
    closing.join(0.05)
    assert closing.is_alive()
    gate.open.set()
    closing.join(WAIT_S)
    assert not closing.is_alive()


@pytest.mark.usefixtures("runner")
def test_as_many_tasks_run_at_a_time_as_there_are_workers() -> None:
    """Three workers run three tasks at a time, and each task once."""
    many = OnboardRunner(3)
    futures = [many.submit(call(number), 1.0) for number in range(6)]
    until_begun(3)
    gate.open.set()
    assert [future.result(WAIT_S).value for future in futures] == list(range(6))
    assert sorted(gate.begun) == list(range(6))
    many.close()


@pytest.mark.parametrize("status", [0, 3])
def test_a_task_that_forks_leaves_no_copy_of_the_robot(runner: OnboardRunner, status: int) -> None:
    """The copy ends when the task returns or exits in it, with the exit code that it asked for."""
    child = runner.submit(call(status, forking), 1.0).result(WAIT_S).value
    _, ended = os.waitpid(child, 0)
    assert os.waitstatus_to_exitcode(ended) == status
