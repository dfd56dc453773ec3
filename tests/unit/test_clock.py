"""The clock of the host, and how the offloader waits with it."""

import threading
from concurrent.futures import Future

import pytest

from offboard.robot_client.sites.waiting import SystemClock


class Waited(Future[int]):
    """A future that notes for how long it is waited for, and does not make the caller wait."""

    timeout_s: float | None = None

    def exception(self, timeout: float | None = None) -> BaseException | None:
        self.timeout_s = timeout
        return super().exception(0.0)


def test_time_never_goes_back() -> None:
    """Later readings are never smaller."""
    clock = SystemClock()
    readings = [clock.now_s() for _ in range(1000)]
    assert readings == sorted(readings)


def test_a_finished_future_ends_the_wait_at_once() -> None:
    """One finished future among several is enough."""
    done: Future[int] = Future()
    done.set_result(1)
    SystemClock().wait([Future(), done], 1e6)


def test_the_wait_ends_with_the_first_answer() -> None:
    """A result that another thread sets ends a wait without a limit."""
    future: Future[int] = Future()
    thread = threading.Thread(target=future.set_result, args=(1,))
    thread.start()
    SystemClock().wait([future, Future()])
    thread.join()
    assert future.done()


def test_the_wait_ends_after_its_timeout() -> None:
    """Without an answer the wait returns, and the future is not done."""
    future: Future[int] = Future()
    SystemClock().wait([future], 0.0)
    assert not future.done()


@pytest.mark.parametrize("timeout_s", [threading.TIMEOUT_MAX * 2, float("inf")])
def test_a_timeout_too_long_for_python_is_shortened(timeout_s: float) -> None:
    """An absurd prediction may ask for such a wait; Python would raise OverflowError."""
    future = Waited()
    SystemClock().wait([future], timeout_s)
    assert future.timeout_s == threading.TIMEOUT_MAX
