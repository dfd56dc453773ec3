"""Intervals that hold what they say."""

import math
from collections.abc import Callable
from random import Random

import pytest

from offboard.robot_client.learning.intervals import COVERAGE, SCORES_MAX, SCORES_MIN, Conformal

TASKS = 6_000

Draw = Callable[[Random, int], tuple[float, float]]  # of task i: predicted and true seconds


def normal(rng: Random, _: int) -> tuple[float, float]:
    predicted = rng.uniform(0.05, 0.5)
    return predicted, max(0.0, predicted + rng.gauss(0, 0.1 * predicted + 0.01))


def skewed(rng: Random, _: int) -> tuple[float, float]:
    predicted = rng.uniform(0.05, 0.5)
    return predicted, predicted * rng.lognormvariate(0, 0.6)


def drifting(rng: Random, i: int) -> tuple[float, float]:
    """The error's mean swings, and its spread grows fivefold over the stream."""
    predicted = rng.uniform(0.05, 0.5)
    error = 0.2 * math.sin(i / 150) + rng.gauss(0, 0.05 + 0.2 * i / TASKS)
    return predicted, max(0.0, predicted * (1 + error))


def stepping(rng: Random, i: int) -> tuple[float, float]:
    """Every 500 tasks the site is twice as slow as predicted, or again as it was."""
    predicted = rng.uniform(0.05, 0.5)
    return predicted, predicted * (1 + i // 500 % 2) * rng.lognormvariate(0, 0.1)


def widening(rng: Random, i: int) -> tuple[float, float]:
    """The noise doubles every 50 tasks: what is remembered alone would hold 81 %."""
    predicted = rng.uniform(0.05, 0.5)
    return predicted, max(0.0, predicted * (1 + rng.gauss(0, 0.02 * 2 ** (i % 250 / 50))))


@pytest.mark.parametrize("draw", [normal, skewed, drifting, stepping, widening])
@pytest.mark.parametrize("seed", [1, 2])
def test_nine_of_ten_times_are_inside(draw: Draw, seed: int) -> None:
    """Over 6,000 tasks the realised share is within 3 points of 90 %, at constant and changing noise."""
    rng, conformal, inside, asked = Random(seed), Conformal(), 0, 0
    for i in range(TASKS):
        predicted, seconds = draw(rng, i)
        ends = conformal.interval(predicted, None)
        if ends is not None:
            asked += 1
            inside += ends[0] <= seconds <= ends[1]
        conformal.learn(predicted, seconds)
    assert asked == TASKS - SCORES_MIN - 1
    assert inside / asked == pytest.approx(COVERAGE, abs=0.03)


@pytest.mark.parametrize("seed", [1, 2])
def test_what_is_given_up_past_the_end_is_among_the_one_of_ten(seed: int) -> None:
    """One run in 20 stalls and is given up: with those counted as missed nine of ten are inside."""
    rng, conformal, inside, asked = Random(seed), Conformal(), 0, 0
    for i in range(TASKS):
        predicted, seconds = normal(rng, i)
        ends = conformal.interval(predicted, None)
        stalls = ends is not None and rng.random() < 0.05
        if ends is not None:
            asked += 1
            inside += not stalls and ends[0] <= seconds <= ends[1]
        if stalls:
            conformal.miss()
        else:
            conformal.learn(predicted, seconds)
    assert inside / asked == pytest.approx(COVERAGE, abs=0.015)


def test_of_normal_errors_the_width_is_that_of_the_normal_interval() -> None:
    """With a constant prediction it comes to 2 x 1.645 standard deviations, to a quarter."""
    rng, conformal, widths = Random(3), Conformal(), []
    for i in range(3_000):
        ends = conformal.interval(0.5, None)
        if i > 500 and ends is not None:
            widths.append(ends[1] - ends[0])
        conformal.learn(0.5, 0.5 + rng.gauss(0, 0.02))
    assert sum(widths) / len(widths) == pytest.approx(2 * 1.645 * 0.02, rel=0.25)


def test_of_skewed_errors_the_upper_side_is_wider() -> None:
    """Each end has a level of its own, as times have a tail on one side."""
    rng, conformal = Random(4), Conformal()
    for _ in range(500):
        conformal.learn(0.5, 0.5 * rng.lognormvariate(0, 0.6))
    ends = conformal.interval(0.5, None)
    assert ends is not None
    assert ends[1] - 0.5 > 1.5 * (0.5 - ends[0])


@pytest.mark.parametrize("draw", [normal, skewed, drifting, stepping])
def test_the_ends_are_in_order_around_the_prediction(draw: Draw) -> None:
    """0 <= low <= predicted <= high, all finite, at every step and also for predictions never seen."""
    rng, conformal = Random(5), Conformal()
    for i in range(1_000):
        predicted, seconds = draw(rng, i)
        for asked in (predicted, 0.0, 1e-9, 1e6):
            ends = conformal.interval(asked, 0.1)
            assert ends is not None
            assert 0 <= ends[0] <= asked <= ends[1] < math.inf
        conformal.learn(predicted, seconds)


def test_before_it_knows_enough_the_spread_tells() -> None:
    """Below ten errors the interval is the normal one, not below 0; without a spread there is none."""
    conformal = Conformal()
    for _ in range(SCORES_MIN):
        assert conformal.interval(0.5, None) is None
        assert conformal.interval(0.5, 0.1) == pytest.approx((0.5 - 0.1645, 0.5 + 0.1645))
        assert conformal.interval(0.1, 0.1) == pytest.approx((0.0, 0.2645))
        conformal.learn(0.5, 0.5)


def test_memory_is_bounded() -> None:
    """However many tasks it learnt from, the last SCORES_MAX errors are kept, and no others count."""
    conformal = Conformal()
    for _ in range(1_000):
        conformal.learn(0.5, 5.0)
    for _ in range(SCORES_MAX):
        conformal.learn(0.5, 0.5)
    assert len(conformal._sorted) == len(conformal._order) == SCORES_MAX
    assert sorted(conformal._order) == conformal._sorted
    ends = conformal.interval(0.5, None)
    assert ends is not None
    assert ends[1] < 0.6, "all that it remembers was exact"


def test_the_share_above_a_limit_is_that_of_the_errors() -> None:
    """Of times spread evenly from 0.4 to 0.6 s half are above 0.5 s, hardly any above 0.7."""
    rng, conformal = Random(6), Conformal()
    assert conformal.share_above(0.5, 0.6) is None
    for _ in range(1_000):
        conformal.learn(0.5, rng.uniform(0.4, 0.6))
    for limit, share in ((0.3, 1.0), (0.5, 0.5), (0.55, 0.25), (0.7, 0.0)):
        assert conformal.share_above(0.5, limit) == pytest.approx(share, abs=0.1)
    assert 0 < (conformal.share_above(0.5, 50.0) or 0) < 0.01, "nothing is certain"


def test_a_late_task_is_overdue_where_waiting_on_is_worth_least() -> None:
    """Times around 1 s and some around 20 s: beyond the first ones, and not while it may still be one."""
    conformal, random = Conformal(), Random(1)
    for n in range(100):
        conformal.learn(1.0, 20.0 if n % 25 == 24 else random.uniform(0.8, 1.2))
    after_s = conformal.overdue(1.0, worth_s=2.0)
    assert after_s is not None
    assert 1.15 < after_s < 1.5
    alone = conformal.overdue(1.0, worth_s=60.0)
    assert alone is not None
    assert alone > 20.0, "nothing else is worth so much"
    assert Conformal().overdue(1.0, 2.0) is None


def test_units_do_not_matter() -> None:
    """Milliseconds for seconds scale the interval alike."""
    small, large = Conformal(), Conformal()
    rng = Random(7)
    for i in range(300):
        predicted, seconds = skewed(rng, i)
        small.learn(predicted, seconds)
        large.learn(1e3 * predicted, 1e3 * seconds)
    one, other = small.interval(0.3, None), large.interval(300.0, None)
    assert one is not None
    assert other == pytest.approx([1e3 * end for end in one], rel=1e-9)
