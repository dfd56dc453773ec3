"""The host's clock, as the offloader waits by it."""

import threading
from concurrent.futures import Future

import pytest

from offboard.robot_client.sites.clock import SystemClock


def test_time_never_goes_back() -> None:
    """Readings in a row do not fall."""
    clock = SystemClock()
    readings = [clock.now_s() for _ in range(1000)]
    assert readings == sorted(readings)


def test_a_done_future_is_not_waited_for() -> None:
    """One of several that is done ends the wait at once."""
    done: Future[int] = Future()
    done.set_result(1)
    SystemClock().wait([Future(), done], 1e6)


def test_the_wait_ends_with_the_first_answer() -> None:
    """A result set by another thread wakes whoever waits without a limit."""
    future: Future[int] = Future()
    thread = threading.Thread(target=future.set_result, args=(1,))
    thread.start()
    SystemClock().wait([future, Future()])
    thread.join()
    assert future.done()


def test_the_wait_ends_after_its_time() -> None:
    """Without an answer it returns, with nothing done."""
    future: Future[int] = Future()
    SystemClock().wait([future], 0.0)
    assert not future.done()


@pytest.mark.parametrize("timeout_s", [threading.TIMEOUT_MAX * 2, float("inf")])
def test_a_wait_longer_than_the_host_can_count_is_still_a_wait(timeout_s: float) -> None:
    """A hedge of an absurd prediction is no error of the task."""
    future: Future[int] = Future()

    def answer() -> None:
        while not (future._waiters or future._condition._waiters):  # type: ignore[attr-defined] - only a wait that has begun can fail
            pass
        future.set_result(1)

    thread = threading.Thread(target=answer, daemon=True)
    thread.start()
    SystemClock().wait([future], timeout_s)
    thread.join()
