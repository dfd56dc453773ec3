"""Random forest, ARIMA and LSTM: what they promise beyond the contract of predictors."""

import math
import random
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import pytest

from offboard.loadgen.rivals import make
from offboard.robot_client.predictors import LEAST_SQUARES, Predictor

Row = tuple[float, float]  # size, seconds

# For each predictor, the fixture that it needs, and after which share of its observations it is fitted again.
REFITTED = {"random-forest": ("forest", 10), "arima": ("series", 4), "lstm": ("torch", 2)}


@pytest.fixture
def forest() -> Any:
    pytest.importorskip("sklearn", reason="scikit-learn is not installed: `make install`")
    from offboard.loadgen.rivals import random_forest as forest

    return forest


@pytest.fixture
def series() -> Any:
    pytest.importorskip("statsmodels", reason="statsmodels is not installed: `make install`")
    from offboard.loadgen.rivals import arima as series

    return series


@pytest.fixture
def torch() -> Any:
    return pytest.importorskip("torch", reason="torch is not installed: `make torch`")


def rows_of(
    shape: Callable[[float], float], count: int, noise_s: float, series: Iterable[float] = (), seed: int = 5
) -> list[Row]:
    """Sizes from 0 to 5 and their times, with normal noise or the given `series`."""
    rng = random.Random(seed)
    sizes = [rng.uniform(0, 5) for _ in range(count)]
    noise = list(series) or [rng.gauss(0, noise_s) for _ in range(count)]
    return [(size, shape(size) + e) for size, e in zip(sizes, noise, strict=True)]


def line(size: float) -> float:
    return 0.1 + 0.03 * size


def bend(size: float) -> float:
    """Flat up to the middle, then a parabola."""
    return 0.1 + 0.03 * max(0.0, size - 2.5) ** 2


def taught(name: str, window: int, rows: Iterable[Row], seed: int = 0) -> Predictor:
    predictor = make(name, window, seed)
    for row in rows:
        predictor.learn(*row)
    return predictor


def seconds(predictor: Predictor, size: float, ahead: int = 1) -> float:
    prediction = predictor.predict(size, ahead)
    assert prediction is not None
    return prediction.seconds


def error(predictor: Predictor, shape: Callable[[float], float]) -> float:
    """Mean absolute error within the sizes of `rows_of`."""
    sizes = np.linspace(0.2, 4.8, 60).tolist()
    return float(np.mean([abs(seconds(predictor, size) - shape(size)) for size in sizes]))


def error_ahead(name: str, window: int, rows: list[Row]) -> float:
    """Mean absolute error of the next time, for each row after the first `window` rows."""
    predictor = taught(name, window, rows[:window])
    errors = []
    for row in rows[window:]:
        errors.append(abs(seconds(predictor, row[0]) - row[1]))
        predictor.learn(*row)
    return sum(errors) / len(errors)


def arma(count: int, phi: float, theta: float, seed: int = 3) -> list[float]:
    """(1 - phi B) r = (1 + theta B) e, with e of 10 ms."""
    rng = random.Random(seed)
    e, r = [0.0], [0.0]
    for _ in range(count + 200):
        e.append(rng.gauss(0, 0.01))
        r.append(phi * r[-1] + e[-1] + theta * e[-2])
    return r[-count:]


@pytest.mark.parametrize("count", [20, 40])
@pytest.mark.parametrize("name", REFITTED)
def test_a_fit_lasts_for_a_share_of_its_observations(
    name: str, count: int, request: pytest.FixtureRequest
) -> None:
    """A model is fitted again after a fixed share of the observations of its last fit."""
    library, part = REFITTED[name]
    request.getfixturevalue(library)
    predictor = taught(name, 40, [(i % 7, 0.1) for i in range(count)])
    assert seconds(predictor, 3.0) == pytest.approx(0.1)
    for _ in range(count // part - 1):
        predictor.learn(3.0, 10.0)
        assert seconds(predictor, 3.0) == pytest.approx(0.1)
    predictor.learn(3.0, 10.0)
    assert seconds(predictor, 3.0) > 0.2


@pytest.mark.parametrize("count", [2, 5, 60, 400])
def test_the_step_function_equals_the_forest(forest: Any, count: int) -> None:
    """For any size, the prediction is exactly that of scikit-learn's forest."""
    rows = [(0.0, 0.1), (1.0, 0.2)] + [(size / 5, time) for size, time in rows_of(bend, count - 2, 0.02)]
    predictor = taught("random-forest", count, rows, seed=9)
    x, y = (np.array(column) for column in zip(*rows, strict=True))
    theirs = forest.RandomForestRegressor(
        forest.TREES, min_samples_leaf=forest.leaf_min(count), random_state=9
    ).fit(x[:, np.newaxis], y)
    seen = np.sort(x)
    asked = np.concatenate([seen, (seen[1:] + seen[:-1]) / 2, np.linspace(-0.5, 1.5, 500)])
    ours = [seconds(predictor, size) for size in asked.tolist()]
    assert ours == theirs.predict(asked[:, np.newaxis]).tolist()


@pytest.mark.usefixtures("forest")
def test_the_forest_accepts_any_range_of_sizes() -> None:
    """It distinguishes sizes that are equal in 32 bits, or too large for them."""
    for low, step in ((1e12, 1.0), (0.0, 1e300), (0.0, 1e-300)):
        predictor = taught("random-forest", 60, [(low + step * i, 0.1 if i < 30 else 0.4) for i in range(60)])
        assert seconds(predictor, low + 5 * step) == pytest.approx(0.1)
        assert seconds(predictor, low + 55 * step) == pytest.approx(0.4)


@pytest.mark.usefixtures("forest")
def test_the_spread_of_the_forest_is_that_of_the_noise() -> None:
    """It is out of bag, so 20 ms of noise in 40 observations stay 20 ms; in sample it would be 16 ms."""
    found = [
        taught("random-forest", 40, rows_of(line, 40, 0.02, seed=seed)).predict(2.0) for seed in range(5)
    ]
    mean = sum(one.spread_s or 0.0 for one in found if one) / len(found)
    assert 0.02 < mean < 0.027


@pytest.mark.parametrize("residuals", [arma(600, 0.7, 0.3), arma(600, 0.9, -0.6)])
def test_the_recursion_equals_statsmodels(series: Any, residuals: list[float]) -> None:
    """After a fit on 400 residuals and 200 more, it forecasts 1 and 40 steps as statsmodels does."""
    values = np.array(residuals)
    ours, _ = series.fit_series(values[:400])
    scale = values[:400].std()
    model = series.ARIMA(values[:400] / scale, order=(1, 0, 1), trend="n", concentrate_scale=True)
    with series.BLAS.limit(limits=1, user_api="blas"):
        theirs = model.fit().append(values[400:] / scale, refit=False)
    one_ahead = []
    for value in values[400:].tolist():
        one_ahead.append(ours.forecast(1))
        ours.follow(value)
    assert one_ahead == pytest.approx((theirs.fittedvalues[400:] * scale).tolist(), abs=1e-6 * scale)
    further = [ours.forecast(ahead) for ahead in range(1, 41)]
    assert further == pytest.approx((theirs.forecast(40) * scale).tolist(), abs=1e-6 * scale)


@pytest.mark.usefixtures("series")
def test_arima_uses_the_residuals() -> None:
    """If residuals keep two thirds of their last value, its error is a fifth below least squares."""
    rows = rows_of(line, 500, 0.0, series=arma(500, 0.67, 0.0))
    arima, plain = error_ahead("arima", 200, rows), error_ahead(LEAST_SQUARES, 200, rows)
    assert arima < 0.8 * plain, (arima, plain)
    # The best predictor would know phi. Its error is the mean absolute value of noise of 10 ms.
    assert arima < 1.1 * 0.01 * math.sqrt(2 / math.pi), arima


@pytest.mark.usefixtures("series")
def test_the_forecast_fades_to_the_line() -> None:
    """With each task since the last observation, the prediction comes closer to least squares."""
    rows = rows_of(line, 200, 0.0, series=[*arma(199, 0.8, 0.0), 0.08])
    predictor, plain = taught("arima", 200, rows), taught(LEAST_SQUARES, 200, rows)
    apart = [abs(seconds(predictor, 2.0, ahead) - seconds(plain, 2.0)) for ahead in (1, 3, 10, 40, 200)]
    assert apart == sorted(apart, reverse=True)
    assert apart[0] > 0.02
    assert apart[-1] < apart[0] / 100
    assert seconds(predictor, 2.0, 10**9) == pytest.approx(seconds(plain, 2.0), rel=1e-9)


def test_without_a_series_the_prediction_is_the_line(series: Any) -> None:
    """With too few observations, or residuals that alternate for ever, it is least squares."""
    few = series.OBSERVATIONS_MIN
    rows = rows_of(line, few - 1, 0.0, series=arma(few - 1, 0.8, 0.0, seed=4))
    flips = [(float(i // 2 % 3), 1.0 + 0.01 * (-1) ** i) for i in range(99)]
    for known in (rows, flips):
        predictor, plain = taught("arima", 100, known), taught(LEAST_SQUARES, 100, known)
        for size in (0.0, 2.0, 50.0):
            assert seconds(predictor, size) == pytest.approx(seconds(plain, size), rel=1e-9)
    predictor = taught("arima", 100, [*rows, (2.0, 0.2)])
    assert seconds(predictor, 2.0) != pytest.approx(seconds(predictor, 2.0, ahead=200), rel=1e-3)


@pytest.mark.usefixtures("torch")
@pytest.mark.parametrize(("shape", "gain"), [(line, 0.15), (bend, 0.25)])
def test_lstm_learns_a_line_and_a_curve(shape: Callable[[float], float], gain: float) -> None:
    """Its error is far below that of the mean time, and on a curve also far below that of a line."""
    rows = rows_of(shape, 300, 0.005)
    lstm = error(taught("lstm", 300, rows), shape)
    mean = sum(time for _, time in rows) / len(rows)
    spread = np.mean([abs(shape(size) - mean) for size in np.linspace(0.2, 4.8, 60).tolist()])
    assert lstm < gain * spread, (lstm, spread)
    if shape is bend:
        assert lstm < 0.5 * error(taught(LEAST_SQUARES, 300, rows), shape)


@pytest.mark.usefixtures("torch")
def test_lstm_saturates_beyond_the_observed_sizes() -> None:
    """Far beyond them the prediction is constant instead of the learnt line."""
    predictor = taught("lstm", 100, rows_of(line, 100, 0.002))
    far = [seconds(predictor, size) for size in (1e6, 1e9, 1e300)]
    assert far[0] == pytest.approx(far[1], rel=1e-3)
    assert far[1] == pytest.approx(far[2], rel=1e-3)
    assert far[0] < line(30)


def test_lstm_depends_on_its_seed_only(torch: Any) -> None:
    """The same seed gives the same answer for any state of torch's generator; another seed does not."""
    rows = rows_of(bend, 60, 0.005)

    def answer(seed: int) -> float:
        torch.rand(3)
        return seconds(taught("lstm", 60, rows, seed), 3.0)

    assert answer(1) == answer(1)
    assert answer(1) != answer(2)


def test_lstm_leaves_torch_as_it_was(torch: Any) -> None:
    """Neither the state of torch's generator nor its number of threads changes."""
    before, threads = torch.get_rng_state(), torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        seconds(taught("lstm", 60, rows_of(line, 60, 0.005)), 3.0)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(torch.get_rng_state(), before)


def test_lstm_learns_inside_inference_mode(torch: Any) -> None:
    """A task may be a torch model, and its caller in a mode that forbids training."""
    rows = rows_of(line, 60, 0.005)
    for mode in (torch.no_grad, torch.inference_mode):
        with mode():
            inside = taught("lstm", 60, rows)
            seconds(inside, 2.0)
        assert seconds(inside, 2.0) == seconds(taught("lstm", 60, rows), 2.0)
