"""The predictor contract, one function per check; tests/unit/test_predictors.py runs them on all predictors.

WINDOWED holds for all but the parts model: its line begins with a guess, and it has no window.

Each check gets `make`, which makes a fresh predictor with window WINDOW, always with the same seed.
"""

import copy
import math
import pickle
import random
from collections.abc import Callable, Iterable

import pytest

from offboard.robot_client.predictors import Predictor

Make = Callable[[], Predictor]
Row = tuple[float, float]  # size, seconds

WINDOW = 50
SIZES = (0.0, 1.3, 2.5, 5.0, 40.0)  # inside and outside of the sizes of `line`
TAUGHT = 100_000
MEMORY_SLACK_BYTES = 512


def refuses_bad_observations(make: Make) -> None:
    """NaN, infinite or negative sizes and seconds raise ValueError, and nothing is learnt."""
    for taught in (0, 5):
        predictor = teach(make(), line(taught))
        before = predict(predictor) if taught else None
        for bad in (math.nan, math.inf, -math.inf, -1e-9):
            for row in ((bad, 1.0), (1.0, bad)):
                with pytest.raises(ValueError, match="finite and not negative"):
                    predictor.learn(*row)
        assert len(predictor) == taught
        assert (predict(predictor) if taught else predictor.predict(1.0)) == before


def predicts_nothing_before_it_has_learnt(make: Make) -> None:
    """A fresh predictor has no observations, is not full, and has no prediction."""
    predictor = make()
    assert (len(predictor), predictor.full) == (0, False)
    assert predictor.predict(1.0) is None


def predicts_from_the_first_observation(make: Make) -> None:
    """After 1, 2, 3 and N observations predictions are finite; spreads are None, or finite and from 0 up."""
    predictor = make()
    for i, row in enumerate(line(WINDOW), start=1):
        predictor.learn(*row)
        if i in (1, 2, 3, WINDOW):
            check_finite(predictor)


def predicts_finite_times_of_any_data(make: Make) -> None:
    """Sizes and seconds from 0 to 1e15, tiny ones and differences, and equal ones give finite predictions."""
    rng = random.Random(11)
    wild = [(10 ** rng.uniform(-15, 15), 10 ** rng.uniform(-15, 15)) for _ in range(WINDOW)]
    near = [(1e15 + i % 3 / 8, 1e-15 * (i % 2)) for i in range(WINDOW)]
    steps = [(float(i % 2), 1e15 * (i % 5 == 0)) for i in range(WINDOW)]
    tiny = [[(float(i % 3), small) for i in range(WINDOW)] for small in (5e-324, 1e-310, 1e-200, 1e-160)]
    for rows in (wild, near, steps, [(0.0, 0.0)] * WINDOW, *tiny):
        check_finite(teach(make(), rows), (0.0, 1.0, 1e15))


def looks_ahead_without_harm(make: Make) -> None:
    """The prediction is finite for any number of tasks since the last observation."""
    predictor = teach(make(), line(WINDOW))
    for ahead in (1, 2, 7, 500):
        prediction = predictor.predict(2.0, ahead)
        assert prediction is not None
        assert math.isfinite(prediction.seconds)


def is_full_after_the_window(make: Make) -> None:
    """`len` counts observations up to the window, and then `full` is true."""
    predictor = make()
    for i, row in enumerate(line(2 * WINDOW), start=1):
        predictor.learn(*row)
        assert len(predictor) == min(i, WINDOW)
        assert predictor.full == (i >= WINDOW)


def has_bounded_memory(make: Make) -> None:
    """A predictor that learnt 100,000 observations is as small as one that learnt the last 2 N."""
    rows = line(2 * WINDOW)

    def taught(rounds: int) -> int:
        predictor = make()
        for _ in range(rounds - 1):
            teach(predictor, rows)
        for i, row in enumerate(rows):  # the last round also predicts, so that fits are part of the size
            predictor.learn(*row)
            if i % 33 == 0:
                predict(predictor)
        return len(pickle.dumps(predictor))

    once, often = taught(1), taught(TAUGHT // len(rows))
    assert often <= once + MEMORY_SLACK_BYTES, f"{once} bytes after one round, {often} after {TAUGHT}"


def gives_the_same_answers_for_the_same_seed(make: Make) -> None:
    """Two predictors with the same seed and the same observations predict exactly the same."""
    rows = line(WINDOW)
    assert predict(teach(make(), rows)) == predict(teach(make(), rows))


def predicts_without_learning(make: Make) -> None:
    """Predictions do not change other predictions."""
    predictor = teach(make(), line(WINDOW))
    first = predict(predictor)
    for size in (0.0, 7e6, 3.0):
        predictor.predict(size)
    assert predict(predictor) == first
    assert len(predictor) == WINDOW


def is_copied_whole(make: Make) -> None:
    """A deep copy and an unpickled copy predict and learn as the original, and do not change it."""
    original = teach(make(), line(WINDOW))
    first = predict(original)
    later = [(size, 3 * seconds) for size, seconds in line(WINDOW, seed=2)]
    copies = [copy.deepcopy(original), pickle.loads(pickle.dumps(original))]
    assert [predict(one) for one in copies] == [first, first]
    learnt = [predict(teach(one, later)) for one in copies]
    assert predict(original) == first
    assert learnt == [predict(teach(original, later))] * 2
    assert learnt[0] != first


def predicts_the_mean_where_all_sizes_are_equal(make: Make) -> None:
    """With one size only, its prediction is in the middle half of the times seen."""
    rng = random.Random(4)
    times = [0.2 + rng.uniform(-0.02, 0.02) for _ in range(WINDOW)]
    predictor = teach(make(), [(3.0, seconds) for seconds in times])
    prediction = predictor.predict(3.0)
    assert prediction is not None
    assert 0.19 <= prediction.seconds <= 0.21, prediction
    check_finite(predictor)


def predicts_constant_times(make: Make) -> None:
    """If every task took the same time, that is the prediction, to a relative 1e-12."""
    for seconds in (0.1, 7.3):
        predictor = teach(make(), [(size, seconds) for size, _ in line(WINDOW)])
        for size in (0.5, 2.5, 4.5):
            prediction = predictor.predict(size)
            assert prediction is not None
            assert prediction.seconds == pytest.approx(seconds, rel=1e-12)


def learns_a_line(make: Make, gain: float) -> None:
    """On t = 0.1 + 0.03 d with noise of 3 ms, its mean error is below `gain` times that of the mean time."""
    rows = line(2 * WINDOW)
    predictor = teach(make(), rows)
    mean = sum(seconds for _, seconds in rows[-WINDOW:]) / WINDOW
    ours = theirs = 0.0
    for size in (0.25 * step for step in range(1, 20)):
        prediction = predictor.predict(size)
        assert prediction is not None
        truth = 0.1 + 0.03 * size
        ours, theirs = ours + abs(prediction.seconds - truth), theirs + abs(mean - truth)
    assert ours < gain * theirs, f"error {ours / 19:.5f} s, that of the mean {theirs / 19:.5f} s"


# The checks that hold for every predictor; how well a line is learnt differs.
CONTRACT: tuple[Callable[[Make], None], ...] = (
    refuses_bad_observations,
    predicts_nothing_before_it_has_learnt,
    predicts_from_the_first_observation,
    predicts_finite_times_of_any_data,
    looks_ahead_without_harm,
    has_bounded_memory,
    gives_the_same_answers_for_the_same_seed,
    predicts_without_learning,
    is_copied_whole,
    predicts_the_mean_where_all_sizes_are_equal,
)
WINDOWED: tuple[Callable[[Make], None], ...] = (is_full_after_the_window, predicts_constant_times)


def line(count: int, seed: int = 1) -> list[Row]:
    """Sizes from 0 to 5, and seconds = 0.1 + 0.03 size with normal noise of 3 ms."""
    rng = random.Random(seed)
    sizes = [rng.uniform(0, 5) for _ in range(count)]
    return [(size, 0.1 + 0.03 * size + rng.gauss(0, 0.003)) for size in sizes]


def teach(predictor: Predictor, rows: Iterable[Row]) -> Predictor:
    for row in rows:
        predictor.learn(*row)
    return predictor


def predict(predictor: Predictor) -> list[float]:
    found = [predictor.predict(size) for size in SIZES]
    return [one.seconds for one in found if one is not None]


def check_finite(predictor: Predictor, sizes: Iterable[float] = SIZES) -> None:
    for size in sizes:
        prediction = predictor.predict(size)
        assert prediction is not None
        assert math.isfinite(prediction.seconds), (size, prediction)
        assert prediction.spread_s is None or 0 <= prediction.spread_s < math.inf, (size, prediction)
