"""Least squares on sizes of several numbers, compared with numpy.linalg.lstsq on the same rows."""

import copy
import math
import pickle

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from offboard.robot_client.predictors.least_squares import LeastSquares

Array = npt.NDArray[np.float64]
Rows = tuple[Array, Array]  # sizes, seconds

RELATIVE = 1e-8


@st.composite
def windows(draw: st.DrawFn, *, determined: bool = False) -> Rows:
    """Rows of 2 to 8 numbers of different scales; `determined`: more than enough rows, and no dependence."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    k = draw(st.integers(2, 8))
    n = draw(st.integers(4 * k, 60)) if determined else draw(st.integers(1, 40))
    sizes = rng.uniform(0, 10, (n, k)) * 10.0 ** rng.integers(-2, 3, k)
    shape = "free" if determined else draw(st.sampled_from(["free", "collinear", "constant", "few", "same"]))
    if shape == "collinear":
        sizes[:, -1] = 3 * sizes[:, 0] + sizes[:, 1]
    elif shape == "constant":
        sizes[:, 0] = 7.1
    elif shape == "few":
        sizes = rng.integers(0, 3, (n, k)).astype(float)
    elif shape == "same":
        sizes[:] = sizes[0]
    return sizes, rng.lognormal(-2, 0.5, n)


def taught(rows: Rows, window: int | None = None) -> LeastSquares:
    predictor = LeastSquares(window or max(2, len(rows[1])))
    for size, seconds in zip(*rows, strict=True):
        predictor.learn(tuple(size.tolist()), float(seconds))
    return predictor


def seconds_of(predictor: LeastSquares, size: Array) -> float:
    prediction = predictor.predict(tuple(size.tolist()))
    assert prediction is not None
    return prediction.seconds


def lstsq(rows: Rows, size: Array) -> float:
    """What numpy.linalg.lstsq with an intercept says for a size."""
    design = np.column_stack([np.ones(len(rows[1])), rows[0]])
    return float(np.append(1.0, size) @ np.linalg.lstsq(design, rows[1], rcond=None)[0])


@given(windows(determined=True), st.integers(0, 2**32))
@settings(max_examples=100)
def test_a_determined_plane_equals_lstsq_everywhere(rows: Rows, seed: int) -> None:
    """With independent numbers and enough rows, every prediction is that of lstsq, also far outside."""
    predictor, rng = taught(rows), np.random.default_rng(seed)
    for size in rows[0].max(axis=0) * rng.uniform(0, 3, (5, rows[0].shape[1])):
        assert seconds_of(predictor, size) == pytest.approx(lstsq(rows, size), rel=RELATIVE, abs=RELATIVE)


@given(windows())
@settings(max_examples=200)
def test_what_the_window_determines_equals_lstsq(rows: Rows) -> None:
    """For its sizes and for those between them, dependent or few as they may be, predictions are its own."""
    predictor, sizes = taught(rows), rows[0]
    for size in [*sizes, *(sizes[:-1] + sizes[1:]) / 2, sizes.mean(axis=0)]:
        assert seconds_of(predictor, size) == pytest.approx(lstsq(rows, size), rel=RELATIVE, abs=RELATIVE)


@given(windows(), st.integers(0, 2**32))
@settings(max_examples=200)
def test_the_rest_has_the_smallest_slopes(rows: Rows, seed: int) -> None:
    """Elsewhere, slopes have the minimum norm, in units of the range of each number; a constant has none."""
    sizes, seconds = rows
    span = np.ptp(sizes, axis=0)
    span[span == 0] = math.inf
    units = (sizes - sizes.mean(axis=0)) / span
    slopes = np.linalg.pinv(units, rcond=1e-10) @ (seconds - seconds.mean())
    predictor, rng = taught(rows), np.random.default_rng(seed)
    for size in (sizes.max(axis=0) + 1) * rng.uniform(0, 2, (5, sizes.shape[1])):
        wanted = seconds.mean() + ((size - sizes.mean(axis=0)) / span) @ slopes
        assert seconds_of(predictor, size) == pytest.approx(wanted, rel=1e-6, abs=1e-6)


@given(windows(determined=True), st.integers(2, 30))
@settings(max_examples=40)
def test_only_the_window_counts(rows: Rows, window: int) -> None:
    """Older rows are forgotten, and the warm-up is over when the window is full."""
    predictor, last = taught(rows, window), (rows[0][-window:], rows[1][-window:])
    assert (len(predictor), predictor.full) == (min(window, len(rows[1])), window <= len(rows[1]))
    size = last[0][0]
    assert seconds_of(predictor, size) == pytest.approx(lstsq(last, size), rel=RELATIVE, abs=RELATIVE)


@given(windows(determined=True))
@settings(max_examples=30)
def test_the_spread_is_that_of_the_residuals(rows: Rows) -> None:
    """Its square is the sum of squared residuals over n - k - 1, as the n - 2 of a line."""
    size = tuple(rows[0][0].tolist())
    prediction = taught(rows).predict(size)
    assert prediction is not None
    rest = rows[1] - [lstsq(rows, one) for one in rows[0]]
    free = len(rows[1]) - len(size) - 1
    assert prediction.spread_s == pytest.approx(math.sqrt(rest @ rest / free), rel=1e-6)
    few = taught((rows[0][: len(size) + 1], rows[1][: len(size) + 1])).predict(size)
    assert few is not None
    assert few.spread_s is None


def test_predictions_are_finite_for_sizes_and_times_of_any_scale() -> None:
    """Numbers from 0 to 1e15, tiny differences and large offsets give finite predictions and spreads."""
    rng = np.random.default_rng(3)
    wild = 10.0 ** rng.uniform(-15, 15, (50, 3))
    near = np.column_stack([1e15 + np.arange(50) % 3 / 8, np.arange(50.0), 3 * np.arange(50.0) + 1e6])
    for sizes in (wild, near, np.zeros((50, 3))):
        predictor = taught((sizes, 10.0 ** rng.uniform(-9, 6, 50)))
        for size in (*sizes, np.zeros(3), np.full(3, 1e15)):
            prediction = predictor.predict(tuple(size.tolist()))
            assert prediction is not None
            assert math.isfinite(prediction.seconds)
            assert prediction.spread_s is not None
            assert math.isfinite(prediction.spread_s)


def test_a_copy_predicts_the_same_and_bad_observations_are_refused() -> None:
    """As every predictor it can be copied, and takes finite numbers from 0 up, always as many."""
    predictor = LeastSquares(5)
    assert predictor.predict((1.0, 2.0)) is None
    for one in range(5):
        predictor.learn((float(one), float(one * one)), 0.1 + one)
    for bad in ((1.0, math.nan), (1.0, -1.0), (1.0, 2.0, 3.0)):
        with pytest.raises(ValueError, match="size"):
            predictor.learn(bad, 1.0)
    for other in (copy.deepcopy(predictor), pickle.loads(pickle.dumps(predictor))):
        assert other.predict((2.0, 9.0)) == predictor.predict((2.0, 9.0))
