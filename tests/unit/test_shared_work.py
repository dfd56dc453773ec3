"""From sizes to work."""

from collections.abc import Callable
from random import Random

import pytest

from offboard.robot_client.learning.shared_work import PAIRS_MAX, SharedWork


def test_nothing_is_known_at_first() -> None:
    """Before any result the work of a size is unknown; one result makes it known."""
    work = SharedWork()
    assert work.predict(3.0) is None
    work.learn(3.0, 70.0)
    assert work.predict(3.0) == 70.0


def bent(size: float) -> float:
    return 10.0 * size**2


@pytest.mark.parametrize("truth", [lambda size: 10 + 20 * size, bent], ids=["line", "bent"])
def test_what_sizes_are_is_learnt(truth: Callable[[float], float]) -> None:
    """Work that grows with size, evenly or not, is told to 6 % among noisy results; a line is off by 30 %."""
    rng, work = Random(1), SharedWork()
    for _ in range(300):
        size = rng.uniform(1, 5)
        work.learn(size, truth(size) * rng.lognormvariate(0, 0.05))
    for size in (1.5, 3.0, 4.5):
        assert work.predict(size) == pytest.approx(truth(size), rel=0.06)


def test_only_the_last_results_count() -> None:
    """In a building where plans are twice the work that is all that is known after PAIRS_MAX results."""
    rng, work = Random(3), SharedWork()
    for n in range(2 * PAIRS_MAX):
        size = rng.uniform(1, 5)
        work.learn(size, 20 * size * (2.0 if n >= PAIRS_MAX else 1.0))
    assert work.predict(3.0) == pytest.approx(120.0)
    assert len(work._order) == len(work._sizes) == len(work._works) == PAIRS_MAX


def test_one_odd_result_does_not_sway() -> None:
    """A result of a hundred times the work moves the next expectation by less than half."""
    rng, work = Random(2), SharedWork()
    for _ in range(100):
        size = rng.uniform(1, 5)
        work.learn(size, 20 * size * rng.lognormvariate(0, 0.05))
    before = work.predict(3.0)
    assert before is not None
    work.learn(3.0, 6_000.0)
    assert work.predict(3.0) == pytest.approx(before, rel=0.5)


def test_work_is_never_below_zero() -> None:
    """Far below the sizes seen a rising line would go under."""
    work = SharedWork()
    for size in range(5, 25):
        work.learn(size, 100.0 * (size - 5) + 1e-3)
    assert work.predict(0.0) == 0.0
