"""How long a site takes under load, from how long it takes otherwise."""

from random import Random

import pytest

from offboard.robot_client.learning.under_load import KEPT, OUTLIER, UnderLoad


def taught(*times: tuple[float, float], onboard: bool = False) -> UnderLoad:
    one = UnderLoad(onboard=onboard)
    for expected_s, seconds in times:
        one.learn(expected_s, seconds)
    return one


def test_one_time_under_load_predicts_all_sizes() -> None:
    """Nothing is known before the first time under load."""
    one = UnderLoad(onboard=True)
    assert not one.known
    one.learn(0.02, 0.28)
    assert one.known
    assert one.expect(0.04) == pytest.approx(0.56)


def test_load_adds_time_to_a_server_and_multiplies_time_onboard() -> None:
    """This is the prior for other sizes if all times seen were of one size."""
    times = [(0.04, 0.12)] * 3
    assert taught(*times).expect(0.02) == pytest.approx(0.12 - 0.02)
    assert taught(*times, onboard=True).expect(0.02) == pytest.approx(0.06)


def test_a_few_times_do_not_make_a_steep_line() -> None:
    """If the smallest of three tasks was the slowest by chance, small tasks are still predicted well."""
    one = taught((0.045, 0.109), (0.0455, 0.209), (0.050, 0.090))
    assert 0.09 < one.expect(0.035) < 0.15


def test_many_times_show_the_true_line() -> None:
    """With KEPT times, the prior has little influence on the line."""
    rng = Random(1)
    one = UnderLoad(onboard=True)
    for _ in range(KEPT):
        expected_s = rng.uniform(0.0, 0.1)
        one.learn(expected_s, 0.07 + 5 * expected_s)
    assert one.expect(0.01) == pytest.approx(0.12, rel=0.4)
    assert one.expect(0.09) == pytest.approx(0.52, rel=0.1)


def test_an_outlier_is_limited() -> None:
    """A time far above the median counts as OUTLIER times the median."""
    one = taught(*[(0.04, 0.1)] * 4, (0.04, 9.0))
    assert one.expect(0.04) == pytest.approx((4 * 0.1 + OUTLIER * 0.1) / 5)


def test_load_never_makes_a_site_faster() -> None:
    """This also holds for very large tasks, and if times of 0 were seen."""
    assert taught((0.04, 0.01)).expect(0.04) == 0.04
    assert taught((0.0, 0.0), onboard=True).expect(0.5) == 0.5
    assert taught((0.04, 0.3), (0.05, 0.2), (0.06, 0.1)).expect(5.0) >= 5.0
