"""What a site takes under load, told by what it takes otherwise."""

from random import Random

import pytest

from offboard.robot_client.learning.under_load import KEPT, OUTLIER, UnderLoad


def taught(*times: tuple[float, float], onboard: bool = False) -> UnderLoad:
    one = UnderLoad(onboard=onboard)
    for expected_s, seconds in times:
        one.learn(expected_s, seconds)
    return one


def test_one_time_under_load_tells_of_all_sizes() -> None:
    """Before it nothing is known."""
    one = UnderLoad(onboard=True)
    assert not one.known
    one.learn(0.02, 0.28)
    assert one.known
    assert one.expect(0.04) == pytest.approx(0.56)


def test_a_server_takes_so_much_longer_and_onboard_so_many_times_as_long() -> None:
    """Where all that was seen was one kind of task."""
    times = [(0.04, 0.12)] * 3
    assert taught(*times).expect(0.02) == pytest.approx(0.12 - 0.02)
    assert taught(*times, onboard=True).expect(0.02) == pytest.approx(0.06)


def test_a_few_times_of_large_tasks_say_little_of_small_ones() -> None:
    """Three on a server, the slowest by chance the smallest: a line through them says a second for none."""
    one = taught((0.045, 0.109), (0.0455, 0.209), (0.050, 0.090))
    assert 0.09 < one.expect(0.035) < 0.15


def test_many_times_tell_the_line() -> None:
    """Whatever was believed before: 0.07 s and five times what is expected without the load."""
    rng = Random(1)
    one = UnderLoad(onboard=True)
    for _ in range(KEPT):
        expected_s = rng.uniform(0.0, 0.1)
        one.learn(expected_s, 0.07 + 5 * expected_s)
    assert one.expect(0.01) == pytest.approx(0.12, rel=0.4)
    assert one.expect(0.09) == pytest.approx(0.52, rel=0.1)


def test_one_odd_time_counts_as_a_few_of_the_usual_ones() -> None:
    """A second run beside it, or a stall."""
    one = taught(*[(0.04, 0.1)] * 4, (0.04, 9.0))
    assert one.expect(0.04) == pytest.approx((4 * 0.1 + OUTLIER * 0.1) / 5)


def test_it_is_never_quicker_than_without_the_load() -> None:
    """Nor where far larger tasks are asked for, or times of 0 were seen."""
    assert taught((0.04, 0.01)).expect(0.04) == 0.04
    assert taught((0.0, 0.0), onboard=True).expect(0.5) == 0.5
    assert taught((0.04, 0.3), (0.05, 0.2), (0.06, 0.1)).expect(5.0) >= 5.0
