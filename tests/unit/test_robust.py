"""Theil-Sen and Huber, compared with scipy, scikit-learn and their definitions, and on awkward data."""

import math
import random
import warnings
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from offboard.common.errors import ConfigError
from offboard.loadgen.rivals import make
from offboard.loadgen.rivals.refitted import Column
from offboard.loadgen.rivals.robust import EPSILON, SAMPLE, Huber, TheilSen, huber_line, median
from offboard.robot_client.predictors import Predictor
from offboard.robot_client.predictors.base import Prediction
from tests.checks import Row, teach

ROBUST = ("theil-sen", "huber")


def taught(name: str, sizes: Column, seconds: Column) -> Predictor:
    return teach(make(name, max(2, len(sizes))), zip(sizes.tolist(), seconds.tolist(), strict=True))


def predicted(predictor: Predictor, size: float) -> Prediction:
    prediction = predictor.predict(size)
    assert prediction is not None
    return prediction


Draw = Callable[[np.random.Generator, int], Column]
SIZES: tuple[Draw, ...] = (
    lambda rng, n: rng.uniform(0, 5, n),
    lambda rng, n: np.round(rng.uniform(0, 5, n)),
    lambda rng, n: 1e7 + rng.uniform(0, 200, n),
    lambda rng, n: rng.pareto(1.0, n),
)
NOISES: tuple[Draw, ...] = (
    lambda rng, n: rng.normal(0, 0.01, n),
    lambda rng, n: rng.normal(0, 0.01, n) + (rng.random(n) < 0.15) * rng.exponential(1, n),
    lambda rng, n: rng.lognormal(-3, 1, n),
    lambda rng, n: np.abs(rng.standard_cauchy(n)),
)


def window_of(seed: int, shortest: int, sizes: Draw, noise: Draw) -> tuple[Column, Column]:
    """Sizes and seconds, each of shape (n,), with outliers, heavy tails and equal sizes."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(shortest, 150))
    d = sizes(rng, n)
    return d, 0.3 + 0.03 * d + noise(rng, n)


@st.composite
def windows(draw: st.DrawFn, shortest: int = 2) -> tuple[Column, Column]:
    seed = draw(st.integers(0, 2**32))
    return window_of(seed, shortest, draw(st.sampled_from(SIZES)), draw(st.sampled_from(NOISES)))


@given(windows())
@settings(max_examples=100)
def test_theil_sen_equals_scipy(window: tuple[Column, Column]) -> None:
    """Line and spread equal scipy's `theilslopes` and `median_abs_deviation` within 1e-12."""
    from scipy.stats import median_abs_deviation, theilslopes

    sizes, seconds = window
    if np.ptp(sizes) == 0:
        return  # scipy has no slope then
    wanted = theilslopes(seconds, sizes, method="separate")
    predictor = taught("theil-sen", sizes, seconds)
    for size in (0.0, float(sizes.mean()), float(sizes.max())):
        line = wanted.intercept + wanted.slope * size
        scale = abs(wanted.intercept) + abs(wanted.slope) * size
        assert predicted(predictor, size).seconds == pytest.approx(line, abs=1e-12 * scale)
    residuals = seconds - np.median(seconds) - wanted.slope * (sizes - np.median(sizes))
    spread = predicted(predictor, 0.0).spread_s
    if len(sizes) < 3:
        assert spread is None
    else:
        assert spread == pytest.approx(1.4826 * median_abs_deviation(residuals), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("n", [1, 2, 3, 5 * SAMPLE, 5 * SAMPLE + 1, 5 * SAMPLE + 2, 31_999])
def test_the_median_is_exact(n: int) -> None:
    """It is exact for few, many, tied and sorted values, and if a sample misleads."""
    values = np.random.default_rng(n).standard_cauchy(n)
    misleading = np.where(np.arange(n) % max(1, n // SAMPLE) == 0, 1e9, values)
    for one in (values, np.round(values), np.sort(values), misleading):
        assert median(one) == np.median(one)


def test_theil_sen_accepts_windows_up_to_2000() -> None:
    """The longest allowed window is fitted. A longer one is refused with the limit and its reason."""
    sizes = np.random.default_rng(0).uniform(0, 5, TheilSen.WINDOW_MAX)
    predictor = taught("theil-sen", sizes, 0.1 + 0.03 * sizes)
    assert predicted(predictor, 2.0).seconds == pytest.approx(0.16, rel=1e-12)
    with pytest.raises(ConfigError, match=r"^window 2001: theil-sen compares all pairs, so at most 2000$"):
        make("theil-sen", TheilSen.WINDOW_MAX + 1)


@pytest.mark.parametrize("sizes", range(len(SIZES)))
def test_huber_equals_scikit_learn(sizes: int) -> None:
    """The objective is never above that of scikit-learn, and equal if its solver reached the minimum.

    Predictions then agree within 1e-4 of the deviation of the times, and sigma within 1e-3, the precision of
    its solver.
    """
    from sklearn.linear_model import HuberRegressor

    compared = 0
    for seed in range(16):
        d, t = window_of(seed, 5, SIZES[sizes], NOISES[seed % 4])
        x, y = standard(d), standard(t)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the solver of scikit-learn warns when it gives up
            theirs = HuberRegressor(epsilon=EPSILON, alpha=0, tol=1e-10, max_iter=10_000).fit(x[:, None], y)
        intercept, slope, sigma = float(theirs.intercept_), float(theirs.coef_[0]), float(theirs.scale_)
        assert objective(x, y, *huber_line(x, y)) <= objective(x, y, intercept, slope, sigma) * (1 + 1e-12)
        if stationary(x, y, intercept, slope, sigma) > 1e-3:
            continue
        compared += 1
        predictor = taught("huber", d, t)
        for size, wanted in zip(d.tolist(), t.min() + np.ptp(t) * (intercept + slope * x), strict=True):
            assert predicted(predictor, size).seconds == pytest.approx(wanted, abs=1e-4 * t.std())
        spread = predicted(predictor, 0.0).spread_s
        assert spread == pytest.approx(np.ptp(t) * sigma * Huber.SIGMA_TO_DEVIATION, rel=1e-3)
    assert compared >= 12


@given(windows(shortest=3))
@settings(max_examples=100)
def test_huber_minimises_its_objective(window: tuple[Column, Column]) -> None:
    """The gradient is 0, or if there is none, no nearby line costs less."""
    assert_minimum(*(standard(column) for column in window))


def standard(column: Column) -> Column:
    return (column - column.min()) / (np.ptp(column) or 1.0)


def objective(x: Column, y: Column, intercept: float, slope: float, sigma: float) -> float:
    """Owen's objective as published: sum(sigma + H(r / sigma) sigma)."""
    r = np.abs(y - intercept - slope * x)
    if sigma == 0:
        return float(2 * EPSILON * r.sum())
    z = r / sigma
    loss = np.where(z < EPSILON, z**2, 2 * EPSILON * z - EPSILON**2)
    return float((sigma + loss * sigma).sum())


def stationary(x: Column, y: Column, intercept: float, slope: float, sigma: float) -> float:
    """The largest derivative of the objective, per observation."""
    z = np.clip((y - intercept - slope * x) / sigma, -EPSILON, EPSILON)
    return float(max(abs(z.mean()), abs((z * x).mean()), abs(1 - (z**2).mean())))


def assert_minimum(x: Column, y: Column) -> None:
    """The objective is convex, so a stationary point, or the lowest nearby, is its minimum."""
    fit = huber_line(x, y)
    if fit[2] > 0 and stationary(x, y, *fit) <= 1e-7:
        return
    rng = np.random.default_rng(0)
    least = objective(x, y, *fit) * (1 - 1e-9)
    for scale in (1e-1, 1e-3, 1e-5):
        for by in rng.normal(0, scale, (50, 3)):
            line = fit[0] + by[0], fit[1] + by[1]
            assert objective(x, y, *line, abs(fit[2] + by[2])) >= least
            assert objective(x, y, *line, fit[2]) >= least


@pytest.mark.parametrize("n", [3, 4, 6, 10, 40])
def test_huber_minimises_its_objective_on_awkward_windows(n: int) -> None:
    """It also does for few points, two sizes, rounded times, distant points, and points exactly on a line."""
    rng = np.random.default_rng(n)
    for _ in range(25):
        few = rng.integers(0, 3, n) / 2
        two = (rng.random(n) < 0.2) * 1.0
        far = np.where(np.arange(n) < 2, 1.0, 0.01 * rng.random(n))
        for x in map(standard, (few, two, far, rng.random(n), rng.pareto(0.5, n), np.zeros(n))):
            rounded = np.round(rng.random(n), 1)
            outliers = (rng.random(n) < 0.3) * rng.normal(0, 5, n)
            levers = (x == 1) * rng.random(n)
            for y in (rounded, 0.2 + 0.5 * x + outliers, 0.03 * x + levers, rng.standard_cauchy(n)):
                assert_minimum(x, standard(y))


@pytest.mark.parametrize("shift", [0.0, 1e7])
def test_the_line_through_most_points_is_found(shift: float) -> None:
    """If 14 of 50 times are far from a line, Huber finds that line and Theil-Sen its slope."""
    rng = np.random.default_rng(1)
    steps = rng.permutation(50)
    seconds = 1.0 + 0.25 * steps
    seconds[:14] += rng.uniform(50, 5000, 14)
    huber, theil_sen = (taught(name, shift + steps, seconds) for name in ("huber", "theil-sen"))
    for step in (0, 20, 49):
        assert predicted(huber, shift + step) == Prediction(pytest.approx(1.0 + 0.25 * step, rel=1e-12), 0.0)
    rise = predicted(theil_sen, shift + 40).seconds - predicted(theil_sen, shift).seconds
    assert rise == pytest.approx(10.0, rel=1e-12)


@pytest.mark.parametrize("name", ROBUST)
def test_a_collinear_window_is_exact(name: str) -> None:
    """Two or more points on a line give that line within 1e-12, and a spread of 0 up to rounding."""
    rng = random.Random(6)
    for n in (2, 3, 4, 50):
        sizes = np.array([rng.uniform(0, 5) for _ in range(n)])
        predictor = taught(name, sizes, 0.1 + 0.03 * sizes)
        for size in (0.0, 2.0, 10.0):
            assert predicted(predictor, size).seconds == pytest.approx(0.1 + 0.03 * size, rel=1e-12)
        spread = predicted(predictor, 0.0).spread_s
        assert spread is None if n == 2 else spread is not None and spread < 1e-15


@pytest.mark.parametrize("name", ROBUST)
def test_equal_sizes_give_a_robust_middle(name: str) -> None:
    """With one size the slope is 0. A fifth of absurd times moves the prediction by less than the noise."""
    rng = np.random.default_rng(2)
    seconds = rng.normal(0.2, 0.01, 50)
    seconds[::5] = 200.0
    predictor = taught(name, np.full(50, 3.0), seconds)
    assert predicted(predictor, 3.0) == predicted(predictor, 0.0)
    assert predicted(predictor, 3.0).seconds == pytest.approx(0.2, abs=0.01)


@pytest.mark.parametrize("name", ROBUST)
def test_equal_times_are_predicted_exactly(name: str) -> None:
    """If all times are equal, they are the prediction for any size, with spread 0."""
    for n in (1, 2, 3, 50):
        for seconds in (0.0, 0.1, 7.3, 1e15):
            predictor = taught(name, np.arange(float(n)), np.full(n, seconds))
            for size in (0.0, 1e6):
                assert predicted(predictor, size) == Prediction(seconds, 0.0 if n > 2 else None)


@pytest.mark.parametrize("name", ROBUST)
def test_the_spread_is_the_deviation_of_normal_noise(name: str) -> None:
    """For 2,000 observations with normal noise of 10 ms, the spread is 10 ms within 5 %."""
    rng = np.random.default_rng(3)
    sizes = rng.uniform(0, 5, 2000)
    predictor = taught(name, sizes, 0.3 + 0.03 * sizes + rng.normal(0, 0.01, 2000))
    assert predicted(predictor, 1.0).spread_s == pytest.approx(0.01, rel=0.05)


values = st.floats(0, 1e15) | st.sampled_from([0.0, 5e-324, 1e-300, 1e-100, 1.0, 1e15])


@pytest.mark.parametrize("name", [*ROBUST, "recursive-least-squares"])
@given(st.lists(st.tuples(values, values), min_size=1, max_size=12), values)
@settings(max_examples=200)
def test_any_data_give_a_finite_prediction(name: str, rows: list[Row], size: float) -> None:
    """Predictions are finite, and nothing warns, for any sizes and seconds up to 1e15."""
    predictor = make(name, 12)
    for row in rows:
        predictor.learn(*row)
        found = predicted(predictor, size)
        assert math.isfinite(found.seconds)
        assert found.spread_s is None or 0 <= found.spread_s < math.inf
