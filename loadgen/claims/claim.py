"""One claim of the paper next to our figure, the rule that says whether they agree, and the settings for it.

The figures are computed in the other files of this folder.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from offboard.common.config import check, part_of, setting
from offboard.common.wording import rounded
from offboard.loadgen import rivals
from offboard.loadgen.table.confidence_intervals import Blocks, Picks, block_length
from offboard.loadgen.table.measured_rows import Column
from offboard.loadgen.table.table_formats import UNDEFINED, Heading
from offboard.loadgen.table.table_settings import ALL, FULL_WINDOW, RowsConfig, TableConfig
from offboard.robot_client.predictors import LEAST_SQUARES

YES, NO, UNCLEAR = "yes", "no", "unclear"
BLOCKS_MIN = 5  # in a resample; resamples of fewer blocks hardly differ from each other
DIGITS, INTERVAL_DIGITS = 4, 3  # of the figures in Markdown and LaTeX
ROUNDING = 1e-9  # a bound this near to a limit is at the limit: sums of a thousand rows are not exact


@dataclass(frozen=True)
class ClaimsConfig(RowsConfig):
    """With which windows and predictors the claims are checked."""

    windows: tuple[str, ...] = setting(
        ("5", "10", "20", "50", "100", "500", FULL_WINDOW),
        "window lengths N; full: fit on the first 80 % of the rows, scored on the rest",
        metavar="N,N,..",
    )
    predictors: tuple[str, ...] = setting(
        (ALL,),
        f"predictors to compare with {LEAST_SQUARES}: {rivals.PREDICTOR_HELP}; or {ALL}",
        metavar="NAME,NAME,..",
    )

    verdicts: bool = setting(False, "print one verdict for each claim of the paper, over all files")

    def __post_init__(self) -> None:
        check(self)
        self.of_table()

    def of_table(self) -> TableConfig:
        """The settings with which `loadgen table` scores the same predictors."""
        return part_of(TableConfig, self)

    def lengths(self) -> tuple[int, ...]:
        """The windows that are a number of rows, shortest first."""
        return tuple(sorted({int(window) for window in self.windows if window != FULL_WINDOW}))

    def rivals(self) -> tuple[str, ...]:
        """The predictors that least squares is compared with."""
        return tuple(name for name in self.of_table().names() if name != LEAST_SQUARES)

    def blocks(self, rows: int, *, overlap: int = 1) -> Blocks:
        """The resamples of this many values; neighbours within `overlap` share rows, and a block."""
        length = max(overlap, self.block or (block_length(rows) if rows else 1))
        return Blocks(rows, length=length, seed=self.seed)


@dataclass(frozen=True, slots=True)
class Figure:
    """One of our figures with its 95 % interval. None: undefined; `exact`: it needs no interval."""

    value: float | None
    low: float | None = None
    high: float | None = None
    exact: bool = False

    def times(self, factor: float) -> "Figure":
        """The same in another unit."""
        value, low, high = (
            None if one is None else factor * one for one in (self.value, self.low, self.high)
        )
        return replace(self, value=value, low=low, high=high)


@dataclass(frozen=True, slots=True)
class Claimed:
    """Between which limits the paper says that the figure is."""

    low: float = -math.inf
    high: float = math.inf

    def agrees(self, figure: Figure) -> str:
        """Yes or no if the whole interval is inside or outside of the limits; otherwise unclear.

        UNDEFINED if there is no figure.
        """
        value = figure.value
        if value is None:
            return UNDEFINED
        low, high = (value, value) if figure.exact else (figure.low, figure.high)
        if low is None or high is None:
            return UNCLEAR
        if self.low + ROUNDING < low and high < self.high - ROUNDING:
            return YES
        return NO if high <= self.low + ROUNDING or self.high - ROUNDING <= low else UNCLEAR


POSITIVE = Claimed(low=0.0)
NEGATIVE = Claimed(high=0.0)
BELOW_ONE = Claimed(high=1.0)
ABOVE_ONE = Claimed(low=1.0)


@dataclass(frozen=True, slots=True)
class Claim:
    """One line of the table. `above` and `below` are the limits of the rule; None: there is none.

    `number` is that of the section in docs/claims.md. `more` is the command that shows more.
    """

    number: int
    claim: str
    theirs: str
    ours: float | None
    low: float | None
    high: float | None
    above: float | None
    below: float | None
    agrees: str
    more: str = ""
    note: str = ""

    @property
    def ours_shown(self) -> str:
        return _shown(self.ours)

    @property
    def interval(self) -> str:
        if self.low is None or self.high is None:
            return UNDEFINED
        low, high = (0.0 if abs(one) < ROUNDING else one for one in (self.low, self.high))
        return f"{rounded(low, INTERVAL_DIGITS)} to {rounded(high, INTERVAL_DIGITS)}"


HEADINGS = {
    "number": Heading("no.", "no.", None),
    "claim": Heading("claim", "claim", None),
    "theirs": Heading("theirs", "theirs", None),
    "ours_shown": Heading("ours", "ours", None),
    "interval": Heading("95 % interval", r"95 \% interval", None),
    "agrees": Heading("agrees", "agrees", None),
}


def claim(
    number: int,
    words: str,
    figure: Figure,
    *,
    theirs: str | float | None = None,
    claimed: Claimed | None = None,
    note: str = "",
) -> Claim:
    """The line of a figure. Without `claimed`, the paper says nothing that it could agree with."""
    above, below = (None, None) if claimed is None else (claimed.low, claimed.high)
    return Claim(
        number=number,
        claim=words,
        theirs=theirs if isinstance(theirs, str) else _shown(theirs),
        ours=figure.value,
        low=figure.low,
        high=figure.high,
        above=None if above == -math.inf else above,
        below=None if below == math.inf else below,
        agrees=UNDEFINED if claimed is None else claimed.agrees(figure),
        note=note,
    )


def unknown(number: int, words: str, why: str) -> Claim:
    return replace(claim(number, words, Figure(None), note=why), agrees=UNDEFINED)


def bootstrapped(blocks: Blocks, figure: Callable[[Picks], Column]) -> Figure:
    """A figure of all rows. It has an interval if the rows are BLOCKS_MIN blocks or more.

    `figure` returns one value for each resample.
    """
    if not blocks.rows:
        return Figure(None)
    value = float(figure(np.arange(blocks.rows)[np.newaxis])[0])
    if not math.isfinite(value):
        return Figure(None)
    if blocks.rows < BLOCKS_MIN * blocks.length:
        return Figure(value)
    return Figure(value, *blocks.interval(figure))


def mean_of(blocks: Blocks, values: Column) -> Figure:
    return bootstrapped(blocks, lambda picks: values[picks].mean(-1))


def ratio(blocks: Blocks, values: Column, others: Column) -> Figure:
    """The sum of one value for each row, as a share of the sum of another one."""

    def share(picks: Picks) -> Column:
        with np.errstate(divide="ignore", invalid="ignore"):
            found: Column = values[picks].sum(-1) / others[picks].sum(-1)
        return found

    return bootstrapped(blocks, share)


def _shown(value: float | None) -> str:
    return UNDEFINED if value is None else f"{value:.{DIGITS}g}"
