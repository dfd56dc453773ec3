"""What may still be spent."""

import math

import pytest

from offboard.common.errors import ConfigError
from offboard.robot_client.policies.allowance import DUPLICATES_FIRST, DUPLICATES_MAX, Allowance


def begin(allowance: Allowance, tasks: int, every_s: float = 1.0, from_s: float = 0.0) -> None:
    for n in range(tasks):
        allowance.begin(from_s + n * every_s)


def test_second_runs_come_by_the_share_of_tasks() -> None:
    """Of 1,000 tasks with a share of 0.1 a hundred run twice, whenever one is left."""
    allowance, ran = Allowance(0.1), 0
    for n in range(1_000):
        allowance.begin(float(n))
        if allowance.duplicates >= 1:
            allowance.duplicate()
            ran += 1
    assert ran == pytest.approx(100 + DUPLICATES_FIRST, abs=1)


def test_what_is_saved_up_is_bounded() -> None:
    """A quiet year leaves DUPLICATES_MAX second runs."""
    allowance = Allowance(0.5)
    begin(allowance, 1_000)
    assert allowance.duplicates == DUPLICATES_MAX


def test_warm_up_is_paid_back() -> None:
    """Second runs beyond what is there are owed: none is left until tasks have made up for them."""
    allowance = Allowance(0.5)
    for _ in range(round(DUPLICATES_FIRST) + 3):
        allowance.duplicate()
    begin(allowance, 7)
    assert allowance.duplicates == pytest.approx(0.5)
    begin(allowance, 1)
    assert allowance.duplicates == pytest.approx(1.0)


def test_what_is_owed_is_bounded() -> None:
    """After a warm-up of a thousand tasks probes come again within a hundred, not after ten thousand."""
    allowance = Allowance(0.1)
    for n in range(1_000):
        allowance.begin(float(n))
        allowance.duplicate()
    begin(allowance, 71)
    assert allowance.duplicates >= 1


def test_without_a_share_nothing_runs_twice() -> None:
    """Share 0 leaves nothing, not even those of the start."""
    none = Allowance(0.0)
    begin(none, 1)
    assert none.duplicates == 0.0


def test_without_caps_all_may_be_spent() -> None:
    """No cap: bytes and joules are unlimited, whatever was spent."""
    allowance = Allowance()
    allowance.spend(1e12, 1e12)
    assert not allowance.capped
    assert (allowance.bytes_left, allowance.joules_left) == (math.inf, math.inf)


def test_a_cap_refills_in_a_minute() -> None:
    """600 bytes a minute: all at once at first, then 10 a second, and no more than a minute's worth."""
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


def test_a_clock_that_stands_fills_nothing() -> None:
    """Tasks of one instant share what is there."""
    allowance = Allowance(bytes_a_minute=600.0)
    allowance.begin(5.0)
    allowance.spend(600.0, 0.0)
    for _ in range(10):
        allowance.begin(5.0)
    assert allowance.bytes_left == 0.0


@pytest.mark.parametrize("wrong", [-0.1, 1.1, math.nan])
def test_a_share_is_from_0_to_1(wrong: float) -> None:
    """Anything else is refused by name."""
    with pytest.raises(ConfigError, match=r"duplicates .* from 0 to 1"):
        Allowance(wrong)


@pytest.mark.parametrize("cap", ["bytes_a_minute", "joules_a_minute"])
@pytest.mark.parametrize("wrong", [-1.0, math.nan])
def test_a_cap_is_not_below_zero(cap: str, wrong: float) -> None:
    """Anything else is refused by name."""
    with pytest.raises(ConfigError, match=r"a minute .* must be 0 or more"):
        Allowance(**{cap: wrong})
