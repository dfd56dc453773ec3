"""95 % confidence intervals by the circular block bootstrap, which resamples rows in blocks of neighbours.

Neighbouring rows are not independent: they share a window, a stretch of road and the state of the link
(Politis and Romano 1992, "A circular block-resampling procedure for stationary data").
The figures themselves are computed by the callers.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from offboard.loadgen.table.measured_rows import Column
from offboard.loadgen.table.table_two_figures import BLOCK_CELLS_MAX

RESAMPLES = 2000
ROWS_MIN = 10  # fewer rows say nothing about how far a figure would move on other rows
PERCENTS = (2.5, 97.5)
BOUNDS = tuple(f"{percent:g} %" for percent in PERCENTS)
CONSTANT = 1e-12  # a variance below this share of the mean square is a rounding error

Picks = npt.NDArray[np.intp]


class Blocks:
    """RESAMPLES resamples of a table with `rows` rows, each drawn in blocks of `length` rows.

    The same seed gives the same resamples, whatever is computed from them.
    """

    def __init__(self, rows: int, *, length: int | None = None, seed: int = 1):
        self.rows = rows
        self.length = min(rows, length or block_length(rows))
        self._seed = seed

    @cached_property
    def _starts(self) -> Picks:
        shape = (RESAMPLES, math.ceil(self.rows / self.length))
        return np.random.default_rng(self._seed).integers(self.rows, size=shape)

    def picks(self) -> Iterator[Picks]:
        """Indices of rows (resamples x rows), a bounded number of resamples at a time to save memory."""
        step = max(1, BLOCK_CELLS_MAX // self.rows)
        for at in range(0, RESAMPLES, step):
            starts = self._starts[at : at + step, :, None]
            within = (starts + np.arange(self.length)) % self.rows
            yield within.reshape(len(starts), -1)[:, : self.rows]

    def intervals(self, figures: Callable[[Picks], dict[str, Any]]) -> tuple[dict[str, Any], ...]:
        """The low and the high end of each figure; None if undefined.

        `figures` returns one value of each figure for each resample. Below ROWS_MIN rows there are no
        intervals.
        """
        return percentiles(self.resampled(figures))

    def interval(self, figure: Callable[[Picks], Column]) -> tuple[float | None, float | None]:
        """The low and the high end of one figure, of which there is one value for each resample."""
        low, high = self.intervals(lambda picks: {"it": figure(picks)})
        return low.get("it"), high.get("it")

    def resampled(self, figures: Callable[[Picks], dict[str, Any]]) -> dict[str, Any]:
        """The values of each figure in all resamples; empty below ROWS_MIN rows."""
        if self.rows < ROWS_MIN:
            return {}
        parts = [figures(picks) for picks in self.picks()]
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def percentiles(resampled: Mapping[str, Any]) -> tuple[dict[str, Any], ...]:
    """The low and the high end of each figure; None if undefined."""
    return tuple(
        {name: _percentile(values, percent) for name, values in resampled.items()} for percent in PERCENTS
    )


def block_length(rows: int) -> int:
    """The square root of the number of rows, rounded up: block size and block count both grow with it."""
    return math.ceil(math.sqrt(rows))


def mean_r(sizes: Column, seconds: Column, length: int) -> Column:
    """`table_two_figures.mean_r` of many series at once (series x rows), by running sums.

    NaN if undefined.
    """
    d = _standardised(sizes)
    t = _standardised(seconds)
    sd, st = _sliding_sum(d, length) / length, _sliding_sum(t, length) / length
    dd, tt = _sliding_sum(d * d, length) / length, _sliding_sum(t * t, length) / length
    vd, vt = dd - sd * sd, tt - st * st
    cov = _sliding_sum(d * t, length) / length - sd * st
    varied = (vd > CONSTANT * dd) & (vt > CONSTANT * tt)
    r = np.divide(
        cov, np.sqrt(vd * vt, where=varied, out=np.ones_like(vd)), where=varied, out=np.zeros_like(vd)
    )
    count = varied.sum(axis=-1)
    found: Column = np.divide(r.sum(axis=-1), count, where=count > 0, out=np.full(len(r), np.nan))
    return found


def _standardised(values: Column) -> Column:
    centred: Column = values - values.mean()
    spread = centred.std()
    return centred / spread if spread > 0 else centred


def _sliding_sum(values: Column, length: int) -> Column:
    total = np.cumsum(values, axis=-1)
    total[:, length:] -= total[:, :-length].copy()
    found: Column = total[:, length - 1 :]
    return found


def _percentile(values: Column, percent: float) -> float | None:
    defined = values[np.isfinite(values)]
    return float(np.percentile(defined, percent)) if len(defined) else None
