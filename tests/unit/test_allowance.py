"""What tasks may still spend: second runs, bytes and joules."""

import math

import pytest

from offboard.robot_client.policies.allowance import DUPLICATES_MAX, Allowance


def begin(allowance: Allowance, tasks: int, every_s: float = 1.0, from_s: float = 0.0) -> None:
    for n in range(tasks):
        allowance.begin(from_s + n * every_s)


def test_second_runs_are_a_share_of_the_tasks() -> None:
    """With a share of 0.1, about a hundred of 1,000 tasks may run twice."""
    allowance, ran = Allowance(0.1), 0
    for n in range(1_000):
        allowance.begin(float(n))
        if allowance.duplicates >= 1:
            allowance.duplicate()
            ran += 1
    assert ran == pytest.approx(100 + DUPLICATES_MAX, abs=1)


def test_saved_second_runs_are_limited() -> None:
    """After 1,000 tasks without a second run, DUPLICATES_MAX are saved up."""
    allowance = Allowance(0.5)
    begin(allowance, 1_000)
    assert allowance.duplicates == DUPLICATES_MAX


def test_a_warm_up_is_paid_back() -> None:
    """Second runs beyond the level are owed, and later tasks must pay for them first."""
    allowance = Allowance(0.5)
    for _ in range(round(DUPLICATES_MAX) + 3):
        allowance.duplicate()
    begin(allowance, 7)
    assert allowance.duplicates == pytest.approx(0.5)
    begin(allowance, 1)
    assert allowance.duplicates == pytest.approx(1.0)


def test_owed_second_runs_are_limited() -> None:
    """After a warm-up of a thousand tasks, probes are possible again within a hundred tasks."""
    allowance = Allowance(0.1)
    for n in range(1_000):
        allowance.begin(float(n))
        allowance.duplicate()
    begin(allowance, 71)
    assert allowance.duplicates >= 1


def test_with_share_0_no_task_runs_twice() -> None:
    """There are no second runs at the start either."""
    none = Allowance(0.0)
    begin(none, 1)
    assert none.duplicates == 0.0


def test_without_caps_bytes_and_joules_are_unlimited() -> None:
    """Spending changes nothing."""
    allowance = Allowance()
    allowance.spend(1e12, 1e12)
    assert not allowance.capped
    assert (allowance.bytes_left, allowance.joules_left) == (math.inf, math.inf)


def test_a_cap_refills_within_a_minute() -> None:
    """A cap of 600 bytes a minute refills by 10 bytes a second, up to 600 bytes."""
    allowance = Allowance(bytes_a_minute=600.0, joules_a_minute=60.0)
    allowance.begin(1000.0)
    assert (allowance.capped, allowance.bytes_left, allowance.joules_left) == (True, 600.0, 60.0)
    allowance.spend(700.0, 30.0)
    assert (allowance.bytes_left, allowance.joules_left) == (-100.0, 30.0)
    allowance.begin(1020.0)
    assert allowance.bytes_left == pytest.approx(100.0)
    assert allowance.joules_left == pytest.approx(50.0)
    allowance.begin(5000.0)
    assert (allowance.bytes_left, allowance.joules_left) == (600.0, 60.0)


def test_caps_do_not_refill_without_time() -> None:
    """Tasks that start at the same instant share what is left."""
    allowance = Allowance(bytes_a_minute=600.0)
    allowance.begin(5.0)
    allowance.spend(600.0, 0.0)
    for _ in range(10):
        allowance.begin(5.0)
    assert allowance.bytes_left == 0.0
