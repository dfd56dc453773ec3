"""Predictors that follow a changing site, and do not jump at an outlier."""

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
    """A time that is a thousand times as long moves the next prediction by at most the clip, 30 ms here."""
    predictor = taught(name, stream(100))
    before = at(predictor)
    predictor.learn(3.0, 500.0)
    assert at(predictor) == pytest.approx(before, abs=0.03)
    plain = RecursiveLeastSquares(50)
    for row in [*stream(100), (3.0, 500.0)]:
        plain.learn(*row)
    assert at(plain) > 5.0, "without clipping the outlier decides"


def test_an_error_beyond_the_clip_counts_as_the_clip() -> None:
    """Huber's psi: errors beyond the clip and at the clip give the same line."""
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
    """At first the usual error is unknown, so any time is believed."""
    scale = Scale()
    for n in range(CLIP_FROM):
        assert scale.clip == float("inf"), n
        scale.add(1.0)
    assert scale.clip == pytest.approx(CLIP * NORMAL)


def test_one_error_makes_the_scale_grow_by_a_bounded_amount() -> None:
    """One huge error counts as GROWTH times the clip. Many in a row become the new scale."""
    scale = Scale()
    for _ in range(100):
        scale.add(1.0)
    scale.add(1e9)
    assert scale.deviation < NORMAL * (1 + GROWTH * CLIP * NORMAL * SCALE_RATE)
    for _ in range(60):
        scale.add(50.0)
    assert scale.deviation == pytest.approx(50.0 * NORMAL, rel=0.1)


def test_regular_outliers_stay_outliers() -> None:
    """With one outlier in 25 tasks the scale settles, and the next outlier is still clipped."""
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
    """If every task takes three times as long, the prediction is soon within a fifth of that."""
    rows = stream(200)
    predictor = taught(name, [*rows, *((size, 3 * seconds) for size, seconds in stream(tasks, seed=2))])
    assert at(predictor) == pytest.approx(1.5, rel=0.2)


def test_kalman_follows_a_step_within_five_tasks() -> None:
    """After two innovations of the same sign beyond two deviations, the level follows the next ones."""
    predictor = taught("kalman", stream(200))
    for size, seconds in stream(5, seed=2):
        predictor.learn(size, seconds + 0.2)
    assert at(predictor) == pytest.approx(0.7, abs=0.04)
    slower = taught("clipped-least-squares", stream(200))
    for size, seconds in stream(5, seed=2):
        slower.learn(size, seconds + 0.2)
    assert abs(at(slower) - 0.7) > 2 * abs(at(predictor) - 0.7)


def test_kalman_does_not_follow_noise() -> None:
    """Without a change, predictions stay within half the noise of the true line."""
    predictor, off = taught("kalman", stream(100)), []
    for size, seconds in stream(300, seed=3):
        off.append(abs(at(predictor, size) - 0.2 - 0.1 * size))
        predictor.learn(size, seconds)
    assert sum(off) / len(off) < 0.006


def test_a_large_outlier_after_a_small_one_is_no_change() -> None:
    """After an innovation of three deviations, one a hundred times as large hardly moves the level."""
    predictor = taught("kalman", stream(200))
    predictor.learn(3.0, 0.53)
    predictor.learn(3.0, 3.5)
    assert at(predictor) == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize("name", ["blind-average", "average"])
def test_the_pace_of_small_tasks_holds_for_large_ones(name: str) -> None:
    """A site has a quarter of its CPU while it only runs tasks of size 1 to 2. The prediction for size 5 is
    four times as long too, and recovers with theirs."""
    rng = Random(4)
    predictor = taught(name, stream(200))
    for slower, expected in ((4, 2.8), (1, 0.7)):
        for _ in range(15):
            size = rng.uniform(1, 2)
            predictor.learn(size, slower * (0.2 + 0.1 * size + rng.gauss(0, 0.01)))
        assert at(predictor, 5.0) == pytest.approx(expected, rel=0.3)


@pytest.mark.parametrize("name", FOLLOWING)
@pytest.mark.parametrize("window", [2, WINDOW_MAX])
def test_every_allowed_window_works(name: str, window: int) -> None:
    """The shortest and the longest window work. A longer one is refused, and the error names it."""
    assert at(taught(name, stream(20), window)) == pytest.approx(0.5, abs=0.1)
    with pytest.raises(ConfigError, match=rf"^window {WINDOW_MAX + 1}: "):
        taught(name, stream(20), WINDOW_MAX + 1)


def test_a_pace_is_bounded() -> None:
    """Neither many times of 0 nor a larger one after them divide by 0."""
    one = Paced(10)
    for seconds in [*[1.0] * 20, *[0.0] * 2000, *[1e15] * 2000]:
        one.learn(2.0, seconds)
        assert 1 / PACE_FAR <= one._pace <= PACE_FAR
    assert 0 < one.expect(2.0) < 1e18


@pytest.mark.parametrize("name", [*FOLLOWING, "bayesian-least-squares"])
@pytest.mark.parametrize("factor", [1e3, 1e-3])
@pytest.mark.parametrize("of", ["seconds", "sizes"])
def test_no_unit_matters(name: str, factor: float, of: str) -> None:
    """The same stream in other units gives the same predictions within 1e-9, including outliers."""
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


def test_the_standard_error_falls_with_observations() -> None:
    """It is smallest where most sizes were, and below a quarter after 16 times as many observations."""
    assert mean_error(20, 3.0) < mean_error(20, 12.0)
    assert mean_error(320, 3.0) < mean_error(20, 3.0) / 4


def mean_error(count: int, size: float) -> float:
    """The mean standard error of 40 repetitions."""
    total = 0.0
    for seed in range(40):
        found = taught("bayesian-least-squares", stream(count, seed), window=1000).predict(size)
        assert found is not None
        assert found.error_s is not None
        total += found.error_s
    return total / 40


def test_the_posterior_holds_the_truth_as_often_as_it_says() -> None:
    """In 400 repetitions, the true mean is within 2 standard errors in 95 %, give or take 4 points."""
    held = 0
    for seed in range(400):
        found = taught("bayesian-least-squares", stream(40, seed=seed, noise=0.05)).predict(3.0)
        assert found is not None
        assert found.error_s is not None
        held += abs(found.seconds - 0.5) < 2 * found.error_s
    assert held / 400 == pytest.approx(0.95, abs=0.04)
