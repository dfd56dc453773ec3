"""Adaptive intervals hold nine of ten times, and the errors that they learn say when a task is late."""

import math
from collections.abc import Callable
from random import Random

import pytest

from offboard.robot_client.learning.conformal import COVERAGE, ERRORS_MAX, Conformal
from offboard.robot_client.policies.hedge import late_after_s
from offboard.robot_client.policies.prediction_errors import ERRORS_MIN, NO_ERRORS, student_90
from tests.outlooks import known

TASKS = 6_000

Draw = Callable[[Random, int], tuple[float, float]]  # predicted and true seconds of task i


def normal(rng: Random, _: int) -> tuple[float, float]:
    predicted = rng.uniform(0.05, 0.5)
    return predicted, max(0.0, predicted + rng.gauss(0, 0.1 * predicted + 0.01))


def skewed(rng: Random, _: int) -> tuple[float, float]:
    predicted = rng.uniform(0.05, 0.5)
    return predicted, predicted * rng.lognormvariate(0, 0.6)


def drifting(rng: Random, i: int) -> tuple[float, float]:
    """The mean of the error swings, and its spread grows fivefold over the run."""
    predicted = rng.uniform(0.05, 0.5)
    error = 0.2 * math.sin(i / 150) + rng.gauss(0, 0.05 + 0.2 * i / TASKS)
    return predicted, max(0.0, predicted * (1 + error))


def stepping(rng: Random, i: int) -> tuple[float, float]:
    """Every 500 tasks the site becomes twice as slow as predicted, or returns to its old speed."""
    predicted = rng.uniform(0.05, 0.5)
    return predicted, predicted * (1 + i // 500 % 2) * rng.lognormvariate(0, 0.1)


def widening(rng: Random, i: int) -> tuple[float, float]:
    """The noise doubles every 50 tasks: an interval over the remembered errors alone would hold 81 %."""
    predicted = rng.uniform(0.05, 0.5)
    return predicted, max(0.0, predicted * (1 + rng.gauss(0, 0.02 * 2 ** (i % 250 / 50))))


@pytest.mark.parametrize("draw", [normal, skewed, drifting, stepping, widening])
@pytest.mark.parametrize("seed", [1, 2])
def test_nine_of_ten_times_are_inside_the_interval(draw: Draw, seed: int) -> None:
    """Over 6,000 tasks the share inside is within 3 points of 90 %, with constant and with changing noise."""
    rng, conformal, inside, asked = Random(seed), Conformal(), 0, 0
    for i in range(TASKS):
        predicted, seconds = draw(rng, i)
        ends = conformal.interval(predicted, None)
        if ends is not None:
            asked += 1
            inside += ends[0] <= seconds <= ends[1]
        conformal.learn(predicted, seconds)
    assert asked == TASKS - ERRORS_MIN - 1
    assert inside / asked == pytest.approx(COVERAGE, abs=0.03)


@pytest.mark.parametrize("seed", [1, 2])
def test_a_task_stopped_after_the_upper_end_counts_as_outside(seed: int) -> None:
    """One run in 20 hangs and is stopped; with these counted as outside, nine of ten times are inside."""
    rng, conformal, inside, asked = Random(seed), Conformal(), 0, 0
    for i in range(TASKS):
        predicted, seconds = normal(rng, i)
        ends = conformal.interval(predicted, None)
        hangs = ends is not None and rng.random() < 0.05
        if ends is not None:
            asked += 1
            inside += not hangs and ends[0] <= seconds <= ends[1]
        if hangs:
            conformal.miss(predicted, seconds)
        else:
            conformal.learn(predicted, seconds)
    assert inside / asked == pytest.approx(COVERAGE, abs=0.015)


def test_a_stopped_task_counts_in_the_tail_and_not_in_the_hedge() -> None:
    """One run in ten is stopped at twice its time: that is known of the tail, and does not delay hedges."""
    rng, hedged, whole = Random(1), Conformal(), Conformal()
    for i in range(200):
        seconds = rng.uniform(0.95, 1.05)
        whole.learn(1.0, seconds)
        if i % 10 == 9:
            hedged.miss(1.0, 2.0)
        else:
            hedged.learn(1.0, seconds)
    assert whole.errors.share_above(1.0, 3.0) == pytest.approx(0.0, abs=0.01)
    assert hedged.errors.share_above(1.0, 3.0) == pytest.approx(0.1, abs=0.02)
    assert whole.errors.below(1.0, 0.95) == pytest.approx(1.05, abs=0.01)
    assert hedged.errors.below(1.0, 0.95) == pytest.approx(2.0, abs=0.1)
    assert len(hedged.errors.stopped) == 12  # those since the oldest of the 100 errors
    due_s = late_after_s(known(1.0, errors=hedged.errors), 0.5)
    assert due_s is not None
    assert due_s < 1.2


@pytest.mark.parametrize("draw", [normal, skewed])
def test_few_errors_give_an_interval_too(draw: Draw) -> None:
    """Over 500 starts, the first ten intervals hold 80 to 97 % of the times; the spread is too small."""
    rng, held = Random(1), list[bool]()
    for _ in range(500):
        conformal = Conformal()
        for i in range(ERRORS_MIN):
            predicted, seconds = draw(rng, i)
            ends = conformal.interval(predicted, 0.1 * predicted)
            assert ends is not None
            held.append(ends[0] <= seconds <= ends[1])
            conformal.learn(predicted, seconds)
    share = sum(held) / len(held)
    print(f"{share:.1%} of {len(held)} times")
    assert 0.80 <= share <= 0.97


def test_the_share_above_a_limit_follows_from_few_errors_and_the_spread() -> None:
    """It is half at the prediction and 5 % at the upper end of the interval; without a spread, unknown."""
    conformal = Conformal()
    for seconds in (1.0, 1.1, 0.9, 1.2):
        conformal.learn(1.0, seconds)
    ends = conformal.interval(1.0, 0.1)
    assert ends is not None
    assert conformal.errors.share_above(1.0, 1.0, 0.1) == pytest.approx(0.5)
    assert conformal.errors.share_above(1.0, ends[1], 0.1) == pytest.approx(0.05, abs=0.001)
    assert conformal.errors.share_above(1.0, ends[1]) is None


def test_normal_errors_give_the_width_of_a_normal_interval() -> None:
    """With a constant prediction the width is 2 x 1.645 standard deviations, to a quarter."""
    rng, conformal, widths = Random(3), Conformal(), []
    for i in range(3_000):
        ends = conformal.interval(0.5, None)
        if i > 500 and ends is not None:
            widths.append(ends[1] - ends[0])
        conformal.learn(0.5, 0.5 + rng.gauss(0, 0.02))
    assert sum(widths) / len(widths) == pytest.approx(2 * 1.645 * 0.02, rel=0.25)


def test_skewed_errors_make_the_upper_side_wider() -> None:
    """The interval is not symmetric: times have a tail on one side."""
    rng, conformal = Random(4), Conformal()
    for _ in range(500):
        conformal.learn(0.5, 0.5 * rng.lognormvariate(0, 0.6))
    ends = conformal.interval(0.5, None)
    assert ends is not None
    assert ends[1] - 0.5 > 1.5 * (0.5 - ends[0])


@pytest.mark.parametrize("draw", [normal, skewed, drifting, stepping])
def test_the_prediction_is_inside_its_interval(draw: Draw) -> None:
    """0 <= low <= predicted <= high, all finite, after every task and for predictions never seen before."""
    rng, conformal = Random(5), Conformal()
    for i in range(1_000):
        predicted, seconds = draw(rng, i)
        for asked in (predicted, 0.0, 1e-9, 1e6):
            ends = conformal.interval(asked, 0.1)
            assert ends is not None
            assert 0 <= ends[0] <= asked <= ends[1] < math.inf
        conformal.learn(predicted, seconds)


def test_with_few_errors_the_spread_gives_the_interval() -> None:
    """The spread counts as one error: errors of 0 narrow the interval. Without a spread there is none."""
    conformal, before_s = Conformal(), math.inf
    for n in range(ERRORS_MIN):
        assert conformal.interval(0.5, None) is None
        ends = conformal.interval(0.5, 0.1)
        assert ends is not None
        assert ends[0] == pytest.approx(max(0.0, 1.0 - ends[1]))
        assert conformal.interval(0.0, 0.1) == pytest.approx((0.0, ends[1] - 0.5))
        if n > 1:  # the first time sets the unit, and gives no error
            assert ends[1] < before_s
        before_s = ends[1]
        conformal.learn(0.5, 0.5)
    assert before_s == pytest.approx(0.5 + 0.1 * student_90(ERRORS_MIN - 1) / math.sqrt(ERRORS_MIN - 1))


def test_old_errors_are_forgotten() -> None:
    """However many tasks were learnt, only the last ERRORS_MAX errors count."""
    conformal = Conformal()
    for _ in range(1_000):
        conformal.learn(0.5, 5.0)
    for _ in range(ERRORS_MAX):
        conformal.learn(0.5, 0.5)
    assert conformal.errors.scores == (0.0,) * ERRORS_MAX
    ends = conformal.interval(0.5, None)
    assert ends is not None
    assert ends[1] < 0.6, "all remembered errors are 0"


def test_the_errors_are_a_value() -> None:
    """What was read before is not changed by what is learnt later, and is made once until then."""
    conformal = Conformal()
    assert conformal.errors == NO_ERRORS
    for n in range(20):
        conformal.learn(0.5, 0.5 + 0.01 * n)
    before = conformal.errors
    assert conformal.errors is before
    scores = before.scores
    conformal.learn(0.5, 9.0)
    assert before.scores == scores
    assert conformal.errors.scores != scores
    assert list(conformal.errors.scores) == sorted(conformal.errors.scores)


def test_the_share_above_a_limit_is_that_of_the_errors() -> None:
    """If times are spread evenly from 0.4 to 0.6 s, half are above 0.5 s and hardly any above 0.7 s."""
    rng, conformal = Random(6), Conformal()
    assert conformal.errors.share_above(0.5, 0.6) is None
    for _ in range(1_000):
        conformal.learn(0.5, rng.uniform(0.4, 0.6))
    errors = conformal.errors
    for limit, share in ((0.3, 1.0), (0.5, 0.5), (0.55, 0.25), (0.7, 0.0)):
        assert errors.share_above(0.5, limit) == pytest.approx(share, abs=0.1)
    assert 0 < (errors.share_above(0.5, 50.0) or 0) < 0.01, "nothing is certain"


def test_units_do_not_matter() -> None:
    """Times in milliseconds instead of seconds scale the interval by the same factor."""
    small, large = Conformal(), Conformal()
    rng = Random(7)
    for i in range(300):
        predicted, seconds = skewed(rng, i)
        small.learn(predicted, seconds)
        large.learn(1e3 * predicted, 1e3 * seconds)
    one, other = small.interval(0.3, None), large.interval(300.0, None)
    assert one is not None
    assert other == pytest.approx([1e3 * end for end in one], rel=1e-9)
