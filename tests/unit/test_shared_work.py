"""The work of a size, learnt from results."""

from collections.abc import Callable
from random import Random

import pytest

from offboard.robot_client.learning.shared_work import NEIGHBOURS, SharedWork
from offboard.robot_client.predictors.base import REMEMBERED


def test_nothing_is_known_at_first() -> None:
    """The work of a size is unknown before the first result."""
    work = SharedWork()
    assert work.predict(3.0) is None
    work.learn(3.0, 70.0)
    assert work.predict(3.0) == 70.0


def bent(size: float) -> float:
    return 10.0 * size**2


@pytest.mark.parametrize("truth", [lambda size: 10 + 20 * size, bent], ids=["line", "bent"])
def test_the_work_of_a_size_is_learnt(truth: Callable[[float], float]) -> None:
    """It is predicted to 6 % from noisy results, also if work is not proportional to size."""
    rng, work = Random(1), SharedWork()
    for _ in range(300):
        size = rng.uniform(1, 5)
        work.learn(size, truth(size) * rng.lognormvariate(0, 0.05))
    for size in (1.5, 3.0, 4.5):
        assert work.predict(size) == pytest.approx(truth(size), rel=0.06)


def test_only_the_last_results_count() -> None:
    """If the work doubles, the old results are forgotten after REMEMBERED new ones."""
    rng, work = Random(3), SharedWork()
    for n in range(2 * REMEMBERED):
        size = rng.uniform(1, 5)
        work.learn(size, 20 * size * (2.0 if n >= REMEMBERED else 1.0))
    assert work.predict(3.0) == pytest.approx(120.0)


@pytest.mark.parametrize("sizes", [1, 3])
def test_equal_sizes_have_the_mean_of_their_newest_work(sizes: int) -> None:
    """Not that of the smallest work; camera frames of one size may take any work."""
    rng, work = Random(4), SharedWork()
    done = []
    for n in range(30 * sizes):
        size = float(n % sizes)
        done.append((size, 10.0**size * rng.uniform(1.0, 2.0)))
        work.learn(*done[-1])
    for size in range(sizes):
        newest = [one for at, one in done if at == size][-NEIGHBOURS:]
        assert work.predict(float(size)) == pytest.approx(sum(newest) / NEIGHBOURS)


def test_an_outlier_has_little_influence() -> None:
    """A result with a hundred times the work changes the prediction by less than half."""
    rng, work = Random(2), SharedWork()
    for _ in range(100):
        size = rng.uniform(1, 5)
        work.learn(size, 20 * size * rng.lognormvariate(0, 0.05))
    before = work.predict(3.0)
    assert before is not None
    work.learn(3.0, 6_000.0)
    assert work.predict(3.0) == pytest.approx(before, rel=0.5)


def test_work_is_never_below_zero() -> None:
    """A steep line would predict negative work for sizes far below those seen."""
    work = SharedWork()
    for size in range(5, 25):
        work.learn(size, 100.0 * (size - 5) + 1e-3)
    assert work.predict(0.0) == 0.0
