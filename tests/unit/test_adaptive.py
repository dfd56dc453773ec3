"""Predictors that follow a site that changes, and do not jump at an outlier."""

from random import Random

import pytest

from offboard.common.errors import ConfigError
from offboard.robot_client import predictors
from offboard.robot_client.predictors import Predictor
from offboard.robot_client.predictors.adaptive import (
    CLIP,
    CLIP_FROM,
    GROWTH,
    NORMAL,
    PACE_FAR,
    SCALE_RATE,
    ClippedLeastSquares,
    Paced,
    Scale,
)
from offboard.robot_client.predictors.least_squares import RecursiveLeastSquares
from offboard.robot_client.predictors.window import WINDOW_MAX

FOLLOWING = ("clipped-least-squares", "kalman", "blind-average", "average")
ROBUST = ("clipped-least-squares", "kalman")


def stream(count: int, seed: int = 1, noise: float = 0.01) -> list[tuple[float, float]]:
    rng = Random(seed)
    sizes = [rng.uniform(1, 5) for _ in range(count)]
    return [(size, max(0.0, 0.2 + 0.1 * size + rng.gauss(0, noise))) for size in sizes]


def taught(name: str, rows: list[tuple[float, float]], window: int = 50) -> Predictor:
    predictor = predictors.make(name, window)
    for row in rows:
        predictor.learn(*row)
    return predictor


def at(predictor: Predictor, size: float = 3.0) -> float:
    found = predictor.predict(size)
    assert found is not None
    return found.seconds


@pytest.mark.parametrize("name", ROBUST)
def test_one_outlier_pulls_by_three_deviations_at_most(name: str) -> None:
    """A time a thousand times as long moves the next prediction by no more than the clip, 30 ms here."""
    predictor = taught(name, stream(100))
    before = at(predictor)
    predictor.learn(3.0, 500.0)
    assert at(predictor) == pytest.approx(before, abs=0.03)
    plain = RecursiveLeastSquares(50)
    for row in [*stream(100), (3.0, 500.0)]:
        plain.learn(*row)
    assert at(plain) > 5.0, "what is not clipped is carried away"


def test_what_is_clipped_is_learnt_as_if_it_lay_there() -> None:
    """Huber's psi: an error beyond the clip leaves the same line behind as one at the clip."""
    far, near = ClippedLeastSquares(50), ClippedLeastSquares(50)
    for row in stream(100):
        far.learn(*row)
        near.learn(*row)
    clip = far._scale.clip
    expected = at(far)
    far.learn(3.0, expected + 100.0)
    near.learn(3.0, expected + clip)
    assert at(far) == pytest.approx(at(near), rel=1e-12)


def test_before_eight_errors_nothing_is_an_outlier() -> None:
    """The first times may be of any size; nothing is known of the usual error."""
    scale = Scale()
    for n in range(CLIP_FROM):
        assert scale.clip == float("inf"), n
        scale.add(1.0)
    assert scale.clip == pytest.approx(CLIP * NORMAL)


def test_the_scale_grows_by_so_much_an_error() -> None:
    """One huge error counts as GROWTH clips; many of them in a row are the new scale."""
    scale = Scale()
    for _ in range(100):
        scale.add(1.0)
    scale.add(1e9)
    assert scale.deviation < NORMAL * (1 + GROWTH * CLIP * NORMAL * SCALE_RATE)
    for _ in range(60):
        scale.add(50.0)
    assert scale.deviation == pytest.approx(50.0 * NORMAL, rel=0.1)


def test_one_outlier_in_twenty_five_stays_one() -> None:
    """However many of them come: the scale settles, and never takes the next one for usual."""
    scale, random = Scale(), Random(1)
    for _ in range(100):
        scale.add(random.gauss(0, 1))
    for n in range(2_000):
        scale.add(100.0 if n % 25 == 0 else random.gauss(0, 1))
        assert scale.clip < 10, n


@pytest.mark.parametrize(
    ("name", "tasks"),
    [("kalman", 30), ("blind-average", 30), ("average", 30), ("clipped-least-squares", 120)],
)
def test_a_lasting_change_is_followed(name: str, tasks: int) -> None:
    """When every task takes three times as long the prediction is within a fifth of that after so many."""
    rows = stream(200)
    predictor = taught(name, [*rows, *((size, 3 * seconds) for size, seconds in stream(tasks, seed=2))])
    assert at(predictor) == pytest.approx(1.5, rel=0.2)


def test_kalman_follows_a_step_within_five_tasks() -> None:
    """After two innovations of one sign beyond two deviations the level is open for the next ones."""
    predictor = taught("kalman", stream(200))
    for size, seconds in stream(5, seed=2):
        predictor.learn(size, seconds + 0.2)
    assert at(predictor) == pytest.approx(0.7, abs=0.04)
    slower = taught("clipped-least-squares", stream(200))
    for size, seconds in stream(5, seed=2):
        slower.learn(size, seconds + 0.2)
    assert abs(at(slower) - 0.7) > 2 * abs(at(predictor) - 0.7)


def test_kalman_does_not_follow_noise() -> None:
    """Without a change its predictions stay within half the noise of the truth."""
    predictor, off = taught("kalman", stream(100)), []
    for size, seconds in stream(300, seed=3):
        off.append(abs(at(predictor, size) - 0.2 - 0.1 * size))
        predictor.learn(size, seconds)
    assert sum(off) / len(off) < 0.006


def test_an_outlier_behind_a_small_one_is_no_change() -> None:
    """An innovation of three deviations and then one a hundred times as large: the level stays near."""
    predictor = taught("kalman", stream(200))
    predictor.learn(3.0, 0.53)
    predictor.learn(3.0, 3.5)
    assert at(predictor) == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize("name", ["blind-average", "average"])
def test_a_pace_seen_on_small_tasks_is_that_of_large_ones(name: str) -> None:
    """A quarter of the CPU, and only tasks of size 1 to 2 go there meanwhile: one of 5 takes four times as
    long too, and is quick again when they are."""
    rng = Random(4)
    predictor = taught(name, stream(200))
    for slower, expected in ((4, 2.8), (1, 0.7)):
        for _ in range(15):
            size = rng.uniform(1, 2)
            predictor.learn(size, slower * (0.2 + 0.1 * size + rng.gauss(0, 0.01)))
        assert at(predictor, 5.0) == pytest.approx(expected, rel=0.3)


@pytest.mark.parametrize("name", FOLLOWING)
@pytest.mark.parametrize("window", [2, WINDOW_MAX])
def test_every_window_that_is_allowed_will_do(name: str, window: int) -> None:
    """The shortest and the longest; what is longer is refused by its own number."""
    assert at(taught(name, stream(20), window)) == pytest.approx(0.5, abs=0.1)
    with pytest.raises(ConfigError, match=rf"^window {WINDOW_MAX + 1}: "):
        taught(name, stream(20), WINDOW_MAX + 1)


def test_a_pace_is_bounded() -> None:
    """Times of 0 for long, and then any: neither is divided by nothing."""
    one = Paced(10)
    for seconds in [*[1.0] * 20, *[0.0] * 2000, *[1e15] * 2000]:
        one.learn(2.0, seconds)
        assert 1 / PACE_FAR <= one._pace <= PACE_FAR
    assert 0 < one.expect(2.0) < 1e18


@pytest.mark.parametrize("name", [*FOLLOWING, "bayesian-least-squares"])
@pytest.mark.parametrize("factor", [1e3, 1e-3])
@pytest.mark.parametrize("of", ["seconds", "sizes"])
def test_no_unit_matters(name: str, factor: float, of: str) -> None:
    """The same stream in other units gives the same predictions, to 1e-9, outliers included."""
    rows = [(size, 9 * seconds if n % 17 == 0 else seconds) for n, (size, seconds) in enumerate(stream(200))]
    rows += [(size, 2 * seconds) for size, seconds in stream(30, seed=2)]
    along, high = (factor, 1.0) if of == "sizes" else (1.0, factor)
    plain, scaled = taught(name, rows), taught(name, [(along * d, high * t) for d, t in rows])
    for size in (0.5, 3.0, 12.0):
        one, other = plain.predict(size), scaled.predict(along * size)
        assert one is not None
        assert other is not None
        assert other.seconds == pytest.approx(high * one.seconds, rel=1e-9)
        assert one.spread_s is not None
        assert other.spread_s == pytest.approx(high * one.spread_s, rel=1e-9)


def test_the_standard_error_falls_with_what_is_known() -> None:
    """It is least where most sizes were, and less than a quarter after 16 times as many."""
    assert mean_error(20, 3.0) < mean_error(20, 12.0)
    assert mean_error(320, 3.0) < mean_error(20, 3.0) / 4


def mean_error(count: int, size: float) -> float:
    """The standard error after so many observations, the mean of 40 repetitions."""
    total = 0.0
    for seed in range(40):
        found = taught("bayesian-least-squares", stream(count, seed), window=1000).predict(size)
        assert found is not None
        assert found.error_s is not None
        total += found.error_s
    return total / 40


def test_the_posterior_holds_the_truth_as_often_as_it_says() -> None:
    """In 400 repetitions the mean time is within 2 standard errors in 95 %, to 4 points."""
    held = 0
    for seed in range(400):
        found = taught("bayesian-least-squares", stream(40, seed=seed, noise=0.05)).predict(3.0)
        assert found is not None
        assert found.error_s is not None
        held += abs(found.seconds - 0.5) < 2 * found.error_s
    assert held / 400 == pytest.approx(0.95, abs=0.04)
