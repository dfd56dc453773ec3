"""Rivals that follow a changing site without jumping at an outlier, or that know how sure they are."""

from random import Random

import pytest

from offboard.common.errors import ConfigError
from offboard.loadgen import rivals
from offboard.loadgen.rivals.adaptive import (
    CLIP,
    CLIP_FROM,
    GROWTH,
    NORMAL,
    SCALE_RATE,
    ClippedLeastSquares,
    Scale,
)
from offboard.loadgen.rivals.recursive import RecursiveLeastSquares
from offboard.robot_client.predictors import Predictor
from offboard.robot_client.predictors.window import WINDOW_MAX

CLIPPED = "clipped-least-squares"


def stream(count: int, seed: int = 1, noise: float = 0.01) -> list[tuple[float, float]]:
    rng = Random(seed)
    sizes = [rng.uniform(1, 5) for _ in range(count)]
    return [(size, max(0.0, 0.2 + 0.1 * size + rng.gauss(0, noise))) for size in sizes]


def taught(name: str, rows: list[tuple[float, float]], window: int = 50) -> Predictor:
    predictor = rivals.make(name, window)
    for row in rows:
        predictor.learn(*row)
    return predictor


def at(predictor: Predictor, size: float = 3.0) -> float:
    found = predictor.predict(size)
    assert found is not None
    return found.seconds


def test_one_outlier_pulls_by_three_deviations_at_most() -> None:
    """A time that is a thousand times as long moves the next prediction by at most the clip, 30 ms here."""
    predictor = taught(CLIPPED, stream(100))
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


def test_a_lasting_change_is_followed() -> None:
    """If every task takes three times as long, the prediction is within a fifth of that after 120 tasks."""
    rows = stream(200)
    predictor = taught(CLIPPED, [*rows, *((size, 3 * seconds) for size, seconds in stream(120, seed=2))])
    assert at(predictor) == pytest.approx(1.5, rel=0.2)


@pytest.mark.parametrize("window", [2, WINDOW_MAX])
def test_every_allowed_window_works(window: int) -> None:
    """The shortest and the longest window work. A longer one is refused, and the error names it."""
    assert at(taught(CLIPPED, stream(20), window)) == pytest.approx(0.5, abs=0.1)
    with pytest.raises(ConfigError, match=rf"^window {WINDOW_MAX + 1}: "):
        taught(CLIPPED, stream(20), WINDOW_MAX + 1)


@pytest.mark.parametrize("name", [CLIPPED, "bayesian-least-squares"])
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
