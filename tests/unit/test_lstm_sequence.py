"""The LSTM on sequences: what it sees that the LSTM on single sizes does not."""

import random

import numpy as np
import pytest

from offboard.loadgen.rivals import make

pytest.importorskip("torch", reason="torch is not installed: `make torch`")


def error_ahead(name: str, rows: list[tuple[float, float]], split: int) -> float:
    """Mean absolute error of the next time, for each row after the first `split` rows."""
    predictor = make(name, split, seed=1)
    for row in rows[:split]:
        predictor.learn(*row)
    errors = []
    for row in rows[split:]:
        prediction = predictor.predict(row[0])
        assert prediction is not None
        errors.append(abs(prediction.seconds - row[1]))
        predictor.learn(*row)
    return sum(errors) / len(errors)


def test_a_load_that_lasts_is_followed() -> None:
    """If a busy site stays busy for ten tasks, its error is less than half of that on single sizes."""
    rng = random.Random(2)
    loads = [rng.choice((1.0, 3.0)) for _ in range(30)]
    rows = [(rng.uniform(0, 5), 0.1 * load + rng.gauss(0, 0.005)) for load in loads for _ in range(10)]
    alone, sequence = (error_ahead(name, rows, 200) for name in ("lstm", "lstm-sequence"))
    assert sequence < 0.5 * alone, (sequence, alone)


def test_a_sequence_ends_with_the_task() -> None:
    """It holds the observations before the task, oldest first, zeros where there are none, and no time."""
    from offboard.loadgen.rivals.lstm import PREVIOUS, LstmSequence

    sizes, times = np.arange(1.0, 9.0), np.arange(11.0, 19.0)
    found = LstmSequence(50)._sequences(sizes, times)
    assert found.shape == (PREVIOUS + 1, 8, 2)
    assert found[:, 7].tolist() == [[3, 13], [4, 14], [5, 15], [6, 16], [7, 17], [8, 0]]
    assert found[:, 1].tolist() == [[0, 0]] * (PREVIOUS - 1) + [[1, 11], [2, 0]]
