"""Recursive least squares, compared with exact arithmetic."""

import math
import random
from collections.abc import Iterator
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from offboard.common.errors import ConfigError
from offboard.loadgen.rivals.recursive import RecursiveLeastSquares
from tests.checks import Row, line, teach

RELATIVE = 1e-9


def exact(rows: list[Row], forgetting: float, size: float) -> Fraction:
    """Least squares with weights forgetting^(n - i), in rational numbers. Equal sizes give the mean."""
    fade = Fraction(forgetting)
    w = [fade ** (len(rows) - 1 - i) for i in range(len(rows))]
    d, t = ([Fraction(row[column]) for row in rows] for column in (0, 1))
    mean_d, mean_t = (sum(a * b for a, b in zip(w, column, strict=True)) / sum(w) for column in (d, t))
    sdd = sum(a * (x - mean_d) ** 2 for a, x in zip(w, d, strict=True))
    sdt = sum(a * (x - mean_d) * (y - mean_t) for a, x, y in zip(w, d, t, strict=True))
    return mean_t + (sdt / sdd if sdd else Fraction(0)) * (Fraction(size) - mean_d)


def seconds_of(predictor: RecursiveLeastSquares, size: float) -> float:
    prediction = predictor.predict(size)
    assert prediction is not None
    return prediction.seconds


@st.composite
def streams(draw: st.DrawFn) -> list[Row]:
    """Streams of sizes (wide, far from zero, jumping, mostly equal, equal) and noisy seconds."""
    rng = random.Random(draw(st.integers(0, 2**32)))
    size = draw(
        st.sampled_from(
            [
                lambda: rng.uniform(0, 1e7),
                lambda: 1e7 + rng.uniform(0, 200),
                lambda: rng.choice([5.0, 1e7]) + rng.random() * 1e-3,
                lambda: 7e6 if rng.random() < 0.05 else 3.0,
                lambda: 4.2,
            ]
        )
    )
    sizes = [size() for _ in range(draw(st.integers(1, 70)))]
    return [(one, rng.lognormvariate(-2, 0.5) + one * 1e-8) for one in sizes]


@given(streams(), st.integers(2, 60), st.booleans())
@settings(max_examples=70)
def test_predictions_equal_weighted_least_squares(rows: list[Row], window: int, fades: bool) -> None:
    """Every prediction equals exact arithmetic to 1e-9, with the default forgetting and without."""
    predictor = RecursiveLeastSquares(window, forgetting=None if fades else 1.0)
    assert predictor.forgetting == (1 - 1 / window if fades else 1.0)
    for i, row in enumerate(rows):
        predictor.learn(*row)
        if i % 13 == 0 or i == len(rows) - 1:
            truth = exact(rows[: i + 1], predictor.forgetting, row[0])
            scale = max(abs(truth), Fraction(max(seconds for _, seconds in rows[: i + 1])))
            assert abs(Fraction(seconds_of(predictor, row[0])) - truth) <= RELATIVE * scale, f"row {i}"


def test_without_forgetting_100_000_executions_count_equally() -> None:
    """With forgetting 1, the line after 100,000 executions is that of least squares over all of them."""
    rows = [(1e7 + 100 * size, seconds) for size, seconds in line(100_000)]
    predictor = RecursiveLeastSquares(50, forgetting=1.0)
    teach(predictor, rows)
    d, t = np.array(rows).T
    d -= 1e7
    slope, intercept = np.polyfit(d, t, 1)
    for size in (0.0, 250.0, 500.0):
        assert seconds_of(predictor, 1e7 + size) == pytest.approx(slope * size + intercept, rel=RELATIVE)


@given(st.floats(0, 1e15), st.floats(0.5, 1), st.integers(0, 2**32))
@settings(max_examples=60)
def test_constant_times_are_predicted_exactly(seconds: float, forgetting: float, seed: int) -> None:
    """Times that never change are predicted exactly, with spread 0, for any sizes."""
    rng = random.Random(seed)
    predictor = RecursiveLeastSquares(50, forgetting=forgetting)
    teach(predictor, [(10 ** rng.uniform(-9, 15), seconds) for _ in range(60)])
    for size in (0.0, 1.0, 1e15):
        prediction = predictor.predict(size)
        assert prediction is not None
        assert (prediction.seconds, prediction.spread_s) == (seconds, 0.0)


def same_size(size: float, rounded: bool) -> Iterator[float]:
    """Many tasks of one size; with `rounded` some are off by one unit in the last place."""
    rng = random.Random(8)
    while True:
        yield math.nextafter(size, math.inf) if rounded and rng.random() < 0.5 else size


@pytest.mark.parametrize("rounded", [False, True])
@pytest.mark.parametrize(
    ("size", "window"), [(0.0, 10), (0.0, 50), (3.0, 10), (3.0, 50), (3.0, 500), (1e7 + 1 / 3, 50)]
)
def test_a_long_run_of_one_size_neither_bends_the_line_nor_keeps_it(
    size: float, window: int, rounded: bool
) -> None:
    """The slope of earlier sizes stays while these have weight, and becomes 0 in the end."""
    predictor = RecursiveLeastSquares(window)
    rng = random.Random(3)
    teach(predictor, [(size + d, t) for d, t in line(4 * window)])
    weights = times = 0.0
    for i, one in enumerate(same_size(size, rounded)):
        seconds = 0.1 + rng.gauss(0, 0.003)
        predictor.learn(one, seconds)
        weights, times = predictor.forgetting * weights + 1, predictor.forgetting * times + seconds
        if i % 50 == 0:
            per_size = seconds_of(predictor, size + 1) - seconds_of(predictor, size)
            assert -0.01 < per_size < 0.06, f"slope {per_size} after {i} tasks of one size"
        if i == 100_000:
            break
    assert seconds_of(predictor, size + 1000) == seconds_of(predictor, size)
    assert seconds_of(predictor, size) == pytest.approx(times / weights, rel=1e-12)


def test_sizes_that_hardly_differ_give_a_slope() -> None:
    """Near 1e7, sizes that differ by a millionth have a slope; sizes that differ in the last digit do not."""
    rng = random.Random(2)
    rows = [(1e7 + rng.random() * 1e-6, 0.0) for _ in range(200)]
    rows = [(size, 0.1 + 1e5 * (size - 1e7)) for size, _ in rows]
    predictor = RecursiveLeastSquares(50)
    teach(predictor, rows)
    for size, seconds in rows[-20:]:
        assert seconds_of(predictor, size) == pytest.approx(seconds, rel=1e-4)
    predictor = RecursiveLeastSquares(50)
    last = [1e7, math.nextafter(1e7, math.inf)]
    teach(predictor, [(last[i % 2], 0.1 + 0.1 * (i % 2)) for i in range(200)])
    assert seconds_of(predictor, 2e7) == pytest.approx(0.15, abs=0.01)


def test_the_spread_is_that_of_the_weighted_residuals() -> None:
    """Its square is the weighted residual sum of squares over W - 2 sum(w^2) / W. It needs 3 executions."""
    rows, window = line(70), 20
    predictor = RecursiveLeastSquares(window)
    for i, row in enumerate(rows, start=1):
        predictor.learn(*row)
        prediction = predictor.predict(1.0)
        assert prediction is not None
        if i < 3:
            assert prediction.spread_s is None
            continue
        d, t = np.array(rows[:i]).T
        w = (1 - 1 / window) ** np.arange(i - 1, -1, -1)
        residuals = t - np.polyval(np.polyfit(d, t, 1, w=np.sqrt(w)), d)
        wanted = math.sqrt(w @ residuals**2 / (w.sum() - 2 * (w @ w) / w.sum()))
        assert prediction.spread_s == pytest.approx(wanted, rel=1e-6)


@pytest.mark.parametrize("count", [4, 10, 300])
def test_the_spread_is_unbiased(count: int) -> None:
    """Over 2,000 streams, the mean of its square is the variance of the noise within 6 %."""
    squares = []
    for seed in range(2000):
        prediction = teach(RecursiveLeastSquares(10), line(count, seed)[-60:]).predict(1.0)
        assert prediction is not None
        assert prediction.spread_s is not None
        squares.append(prediction.spread_s**2)
    assert np.mean(squares) == pytest.approx(0.003**2, rel=0.06)


@pytest.mark.parametrize("forgetting", [0.0, 0.49, 1.01, math.nan])
def test_a_forgetting_out_of_bounds_is_refused(forgetting: float) -> None:
    """The message says what is allowed."""
    with pytest.raises(ConfigError, match=r"forgetting .*: must be from 0\.5 to 1"):
        RecursiveLeastSquares(50, forgetting=forgetting)
