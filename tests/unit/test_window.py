"""The window and least squares, compared with exact arithmetic."""

import math
import random
from collections import deque
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from offboard.common.errors import ConfigError
from offboard.robot_client.predictors import LEAST_SQUARES, make
from offboard.robot_client.predictors.window import Window

SPREAD_MIN = 1e-5  # share of the mean of d above which predictions are exact to RELATIVE


RELATIVE = 1e-9


def exact(window: deque[tuple[float, float]], size: float) -> Fraction:
    """Least squares in rational numbers. If all sizes are equal, p = mean t."""
    d = [Fraction(size) for size, _ in window]
    t = [Fraction(seconds) for _, seconds in window]
    mean_d, mean_t = sum(d) / len(d), sum(t) / len(t)
    sdd = sum((x - mean_d) ** 2 for x in d)
    sdt = sum((x - mean_d) * (y - mean_t) for x, y in zip(d, t, strict=True))
    return mean_t + (sdt / sdd if sdd else Fraction(0)) * (Fraction(size) - mean_d)


def spread_of(window: deque[tuple[float, float]]) -> float:
    """The range of the sizes, as a share of their mean."""
    sizes = [size for size, _ in window]
    mean = math.fsum(sizes) / len(sizes)
    return (max(sizes) - min(sizes)) / mean if mean else 0.0


def sizes_stream(kind: str, rng: random.Random, count: int) -> list[float]:
    """Streams that are hard for rolling sums: large offsets, jumps, outliers, runs of equal sizes."""
    if kind == "wide":
        return [rng.uniform(0, 1e7) for _ in range(count)]
    if kind == "offset":
        return [1e7 + rng.uniform(0, 200) for _ in range(count)]
    if kind == "jumps":
        return [rng.choice([5.0, 1e7]) + rng.random() * 1e-3 for _ in range(count)]
    if kind == "runs":
        return [float(rng.choice([3, 7_000_000])) if i % 17 == 0 else 3.0 for i in range(count)]
    if kind == "outliers":
        return [1e7 if rng.random() < 0.01 else rng.uniform(0, 5) for _ in range(count)]
    return [4.2] * count


STREAMS = ("wide", "offset", "jumps", "runs", "outliers", "equal")


@given(
    st.sampled_from(STREAMS),
    st.integers(2, 40) | st.sampled_from([100, 250]),
    st.integers(0, 2**32),
)
@settings(max_examples=120)
def test_predictions_equal_exact_arithmetic(stream: str, length: int, seed: int) -> None:
    """Every prediction equals exact arithmetic within 1e-9. Equal sizes give the mean."""
    rng = random.Random(seed)
    count = min(4 * length, 260) + 3
    check_stream(sizes_stream(stream, rng, count), length, rng)


def test_predictions_equal_exact_arithmetic_at_a_window_of_1000() -> None:
    """The same holds for N = 1,000, on the streams with the most cancellation."""
    for stream in ("offset", "outliers"):
        rng = random.Random(9)
        check_stream(sizes_stream(stream, rng, 2300), 1000, rng, every=331)


def check_stream(sizes: list[float], length: int, rng: random.Random, every: int = 7) -> None:
    predictor, window = make(LEAST_SQUARES, length), deque[tuple[float, float]](maxlen=length)
    for i, size in enumerate(sizes):
        seconds = rng.lognormvariate(-2, 0.5) + size * 1e-8
        predictor.learn(size, seconds)
        window.append((size, seconds))
        if i % every == 0 or len(window) < 4:
            compare(predictor.predict(size).seconds, window, size)  # type: ignore[union-attr]


def compare(predicted: float, window: deque[tuple[float, float]], size: float) -> None:
    truth = exact(window, size)
    scale = max(abs(truth), Fraction(math.fsum(t for _, t in window) / len(window)))
    error = float(abs(Fraction(predicted) - truth) / scale)
    spread = spread_of(window)
    if spread == 0 or spread >= SPREAD_MIN:
        assert error <= RELATIVE, f"off by {error:.2e} at N={len(window)}, spread {spread:.1e}"
    else:
        d, t = (np.array(column) for column in zip(*window, strict=True))
        import warnings

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # polyfit warns that the fit is poor
            rival = np.polyval(np.polyfit(d, t, 1), size)
        assert error <= max(RELATIVE, float(abs(Fraction(float(rival)) - truth) / scale))


def test_nearly_equal_sizes_are_fitted_as_well_as_by_polyfit() -> None:
    """If sizes differ by less than 1e-5 of their mean, the line is at least as exact as numpy.polyfit."""
    rng = random.Random(4)
    for width in (1e-2, 1e-4, 1e-6):
        check_stream([1e7 + rng.random() * width for _ in range(200)], 50, rng, every=11)


def test_the_window_keeps_the_last_n_in_order() -> None:
    """Appending to a full window drops only the oldest observation."""
    window = Window(3)
    for i in range(5):
        assert window.full == (i >= 3)
        window.append(float(i), i / 10)
    assert list(window) == [(2.0, 0.2), (3.0, 0.3), (4.0, 0.4)]


def test_the_spread_is_the_standard_deviation_of_the_residuals() -> None:
    """It is the root of the residual sum of squares over N - 2, and unknown for two observations."""
    predictor = make(LEAST_SQUARES, 10)
    points = [(1.0, 1.0), (2.0, 2.5), (3.0, 2.5), (4.0, 4.0)]
    for size, seconds in points[:2]:
        predictor.learn(size, seconds)
    assert predictor.predict(1.0).spread_s is None  # type: ignore[union-attr]
    for size, seconds in points[2:]:
        predictor.learn(size, seconds)
    slope, intercept = np.polyfit(*zip(*points, strict=True), 1)
    residuals = [t - slope * d - intercept for d, t in points]
    wanted = math.sqrt(sum(r * r for r in residuals) / 2)
    assert predictor.predict(1.0).spread_s == pytest.approx(wanted)  # type: ignore[union-attr]


@pytest.mark.parametrize("bad", [(math.nan, 1.0), (1.0, math.inf), (-1.0, 1.0), (1.0, -0.1)])
def test_a_bad_observation_is_refused(bad: tuple[float, float]) -> None:
    """NaN, infinite and negative values raise ValueError."""
    predictor = make(LEAST_SQUARES, 5)
    with pytest.raises(ValueError, match="finite and not negative"):
        predictor.learn(*bad)
    assert len(predictor) == 0
    assert predictor.predict(1.0) is None


@pytest.mark.parametrize("length", [0, 1, -3, 10**9])
def test_a_window_length_out_of_bounds_is_refused(length: int) -> None:
    """The message says what is allowed."""
    with pytest.raises(ConfigError, match="must be from 2 to"):
        Window(length)
