"""Confidence intervals by block bootstrap, compared with theory and with exact figures."""

import math

import numpy as np
import pytest

from offboard.loadgen.table import confidence_intervals as bootstrap
from offboard.loadgen.table import table_two_figures as score
from offboard.loadgen.table.confidence_intervals import Blocks, block_length


def means(values: np.ndarray, blocks: Blocks) -> tuple[float, float]:
    low, high = blocks.intervals(lambda picks: {"mean": values[picks].mean(-1)})
    assert low["mean"] is not None
    assert high["mean"] is not None
    return low["mean"], high["mean"]


def test_a_resample_consists_of_blocks_of_neighbours() -> None:
    """A resample is as long as the table; the rows of a block are neighbours, also across the table's end."""
    (picks,) = Blocks(10, length=4).picks()
    assert picks.shape == (bootstrap.RESAMPLES, 10)
    for at in (1, 2, 3, 5, 6, 7, 9):
        assert ((picks[:, at] - picks[:, at - 1]) % 10 == 1).all()
    assert set(picks[:, 0]) == set(range(10))


def test_the_interval_of_independent_rows_agrees_with_theory() -> None:
    """For independent values and blocks of one row it is mean +- 1.96 standard errors, within 10 %."""
    values = np.random.default_rng(3).exponential(size=1000)
    low, high = means(values, Blocks(1000, length=1))
    error = values.std() / math.sqrt(1000)
    assert high - values.mean() == pytest.approx(1.96 * error, rel=0.1)
    assert values.mean() - low == pytest.approx(1.96 * error, rel=0.1)


def test_blocks_widen_the_interval_of_dependent_rows() -> None:
    """For AR(1) with 0.8 the true interval is 3 times wider; blocks of rows find most of that."""
    noise = np.random.default_rng(4).normal(size=4000)
    values = np.zeros(4000)
    for at in range(1, 4000):
        values[at] = 0.8 * values[at - 1] + noise[at]
    one, many = (np.diff(means(values, Blocks(4000, length=length)))[0] for length in (1, None))
    assert 2.3 < many / one < 3.5, many / one


def test_the_interval_depends_on_the_seed_and_not_on_the_memory_limit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The same seed gives the same interval, even if fewer resamples fit in memory."""
    values = np.random.default_rng(5).normal(size=100)
    first = means(values, Blocks(100, seed=1))
    monkeypatch.setattr(bootstrap, "BLOCK_CELLS_MAX", 700)
    assert means(values, Blocks(100, seed=1)) == first
    assert means(values, Blocks(100, seed=2)) != first


@pytest.mark.parametrize("length", [3, 20, 200])
def test_the_fast_correlation_equals_the_exact_one(length: int) -> None:
    """The r from running sums equals the r of the table to 1e-9, even if a column is partly constant."""
    random = np.random.default_rng(6)
    sizes, seconds = random.uniform(0, 5, 200), random.uniform(0.1, 0.3, 200)
    sizes[50:60] = 2.0
    (found,) = bootstrap.mean_r(sizes[None], seconds[None], length)
    assert found == pytest.approx(score.mean_r(sizes, seconds, length), abs=1e-9)


def test_the_correlation_of_a_constant_is_undefined() -> None:
    """Equal times have no r, and its interval has no bounds."""
    sizes, seconds = np.arange(30.0), np.full(30, 0.1)
    assert math.isnan(bootstrap.mean_r(sizes[None], seconds[None], 5)[0])
    ends = Blocks(30).intervals(lambda picks: {"r": bootstrap.mean_r(sizes[picks], seconds[picks], 5)})
    assert ends == ({"r": None}, {"r": None})


def test_few_rows_have_no_interval() -> None:
    """Below ten rows there is no interval, because its bounds would be misleadingly close."""
    assert Blocks(9).intervals(lambda picks: {"mean": np.ones(len(picks))}) == ({}, {})
    assert Blocks(10).intervals(lambda picks: {"mean": np.ones(len(picks))}) == ({"mean": 1.0},) * 2


def test_the_block_length_grows_with_the_table() -> None:
    """A block has 32 rows at 1,000 rows, and never more rows than the table."""
    assert [block_length(rows) for rows in (1, 2, 200, 1000)] == [1, 2, 15, 32]
    assert Blocks(5, length=100).length == 5
