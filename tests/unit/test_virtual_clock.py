"""Virtual time: the order of events, the end of a wait, and several callers on one clock."""

from concurrent.futures import Future

import pytest

from offboard.loadgen.simulation.model.stepped_offloader import Walk, Walker
from offboard.testing.virtual_clock import VirtualClock


def test_a_wait_ends_with_the_first_future_or_the_timeout() -> None:
    """Events happen in order of time, then in the order they were added, and none after the wait."""
    clock, seen, done = VirtualClock(), [], Future[None]()
    for name, due_s in (("c", 3.0), ("a", 1.0), ("b", 1.0)):
        clock.at(due_s, lambda name=name: seen.append(name))
    clock.at(2.0, lambda: done.set_result(None))
    clock.wait([Future(), done], 9.0)
    assert (clock.now_s(), seen) == (2.0, ["a", "b"])
    clock.wait([done])
    assert clock.now_s() == 2.0
    clock.wait([Future()], 0.5)
    assert (clock.now_s(), seen) == (2.5, ["a", "b"])
    clock.pass_by(1.5)
    assert (clock.now_s(), seen) == (4.0, ["a", "b", "c"])


def test_callers_run_one_at_a_time_in_order() -> None:
    """Each caller runs until it waits; callers of one event continue in the order they started to wait."""
    clock, seen, gate = VirtualClock(), [], Future[None]()

    def caller(name: str, seconds: float) -> Walk:
        seen.append(f"{name} at {clock.now_s():g}")
        yield (), seconds
        seen.append(f"{name} at {clock.now_s():g}")
        yield [gate], None
        seen.append(f"{name} at {clock.now_s():g}")

    Walker(clock, caller("a", 2.0)).begin()
    Walker(clock, caller("b", 1.0)).begin()
    clock.at(5.0, lambda: gate.set_result(None))
    clock.pass_by(9.0)
    assert seen == ["a at 0", "b at 0", "b at 1", "a at 2", "b at 5", "a at 5"]


def test_a_wait_for_a_future_that_is_done_takes_no_time() -> None:
    """The caller goes on at once, and a timeout of the wait before wakes it no more."""
    clock, seen, done = VirtualClock(), [], Future[None]()
    done.set_result(None)

    def caller() -> Walk:
        yield [done], 1.0
        seen.append(clock.now_s())
        yield (), 3.0
        seen.append(clock.now_s())

    Walker(clock, caller()).begin()
    clock.pass_by(5.0)
    assert seen == [0.0, 3.0]


def test_an_exception_of_a_caller_is_raised_by_the_clock() -> None:
    """Whoever lets time pass gets the exception, so no failure is hidden."""
    clock = VirtualClock()

    def caller() -> Walk:
        yield (), 1.0
        raise ValueError("seen")

    Walker(clock, caller()).begin()
    with pytest.raises(ValueError, match="seen"):
        clock.pass_by(2.0)
