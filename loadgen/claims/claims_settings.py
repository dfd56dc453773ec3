"""The settings of `loadgen claims`."""

from dataclasses import dataclass

from offboard.common.config import check, setting
from offboard.loadgen import rivals
from offboard.loadgen.table.confidence_intervals import Blocks, block_length
from offboard.loadgen.table.table_formats import FORMATS
from offboard.loadgen.table.table_settings import ALL, FULL_WINDOW, TableConfig
from offboard.robot_client import predictors


@dataclass(frozen=True)
class ClaimsConfig:
    """With which windows and predictors the claims are checked."""

    windows: tuple[str, ...] = setting(
        ("10", "50", "100", FULL_WINDOW),
        "window lengths N; full: fit on the first 80 % of the rows, scored on the rest",
        metavar="N,N,..",
    )
    predictors: tuple[str, ...] = setting(
        (ALL,),
        f"predictors to compare with {predictors.LEAST_SQUARES}: {rivals.PREDICTOR_HELP}; or {ALL}",
        metavar="NAME,NAME,..",
    )
    block: int | None = setting(
        None,
        "rows in each block of the bootstrap (default: the square root of the number of rows)",
        minimum=1,
    )
    seed: int = setting(1, "random seed of the bootstrap, of shuffling and of random predictors", minimum=0)
    format: str = setting("md", "output format", choices=FORMATS)
    kind: str | None = setting(None, "kind of task, if the trace holds several kinds")

    def __post_init__(self) -> None:
        check(self)
        self.of_table()

    def of_table(self) -> TableConfig:
        """The settings with which `loadgen table` scores the same predictors."""
        return TableConfig(
            windows=self.windows, predictors=self.predictors, block=self.block, seed=self.seed, kind=self.kind
        )

    def lengths(self) -> tuple[int, ...]:
        """The windows that are a number of rows, shortest first."""
        return tuple(sorted({int(window) for window in self.windows if window != FULL_WINDOW}))

    def rivals(self) -> tuple[str, ...]:
        """The predictors that least squares is compared with."""
        return tuple(name for name in self.of_table().names() if name != predictors.LEAST_SQUARES)

    def blocks(self, rows: int, *, overlap: int = 1) -> Blocks:
        """The resamples of this many values; neighbours within `overlap` share rows, and a block."""
        length = max(overlap, self.block or (block_length(rows) if rows else 1))
        return Blocks(rows, length=length, seed=self.seed)
