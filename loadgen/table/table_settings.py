"""The settings of `loadgen table`, and those that it shares with `loadgen replay` and `loadgen claims`."""

from dataclasses import dataclass

from offboard.common.config import check, setting
from offboard.common.errors import ConfigError
from offboard.loadgen import rivals
from offboard.loadgen.table.confidence_intervals import Blocks
from offboard.loadgen.table.table_columns import ColumnSettings, FormatSettings
from offboard.robot_client import predictors
from offboard.robot_client.predictors.window import WINDOW_MAX

CHOSEN, FULL, NONE, BOTH = "chosen", "full", "none", "both"
FULL_WINDOW = "full"  # the last line of the paper: fit once on the first 80 %; not a feedback mode
PAPER_WINDOWS = ("5", "10", "20", "30", "40", "50", "75", "100", "500", FULL_WINDOW)
ALL = "all"


@dataclass(frozen=True)
class RowsConfig(FormatSettings):
    """The settings of every command that computes figures from measured rows."""

    block: int | None = setting(
        None,
        "rows in each block of the bootstrap (default: the square root of the number of rows)",
        minimum=1,
    )
    seed: int = setting(1, "seed of everything random: bootstrap, shuffled rows and predictors", minimum=0)
    kind: str | None = setting(None, "kind of task, if the trace holds several kinds")


@dataclass(frozen=True)
class MeasuredTimesConfig(ColumnSettings, RowsConfig):
    """The settings that `table` and `replay` share."""

    feedback: str = setting(
        CHOSEN,
        "which site learns after warm-up: the chosen one (as a robot does), every site (full), or one table"
        " for each (both)",
        choices=(CHOSEN, FULL, BOTH),
    )
    bootstrap: bool = setting(False, "add a 95 % confidence interval to each figure")

    def modes(self) -> tuple[str, ...]:
        """The feedback modes; each gets its own table."""
        return (CHOSEN, FULL) if self.feedback == BOTH else (self.feedback,)

    def blocks(self, rows: int) -> Blocks:
        return Blocks(rows, length=self.block, seed=self.seed)


@dataclass(frozen=True)
class TableConfig(MeasuredTimesConfig):
    """What to print: every predictor, with every window, in every feedback mode."""

    windows: tuple[str, ...] = setting(
        PAPER_WINDOWS,
        "window lengths N; full: fit on the first 80 % of the rows, scored on the rest",
        metavar="N,N,..",
    )
    predictors: tuple[str, ...] = setting(
        (predictors.LEAST_SQUARES,),
        f"predictors to evaluate: {rivals.PREDICTOR_HELP}; or {ALL}",
        metavar="NAME,NAME,..",
    )
    published: bool = setting(False, "put the lines of the paper's Table II below those of the same N")
    every_window: bool = setting(
        False, "run slow predictors (forest, ARIMA, LSTMs) with every N, not only full; may take an hour"
    )

    def __post_init__(self) -> None:
        check(self)
        for window in self.windows:
            if window != FULL_WINDOW and not _is_length(window):
                allowed = f"a whole number from 2 to {WINDOW_MAX} nor {FULL_WINDOW}"
                raise ConfigError(f"--windows: {window!r} is neither {allowed}")
        for name in self.predictors:
            if name != ALL:
                rivals.predictor(name, "--predictors")

    def names(self) -> tuple[str, ...]:
        named = (rivals.PREDICTORS if name == ALL else (name,) for name in self.predictors)
        return tuple(dict.fromkeys(name for group in named for name in group))


def _is_length(window: str) -> bool:
    digits_max = len(str(WINDOW_MAX))
    return window.isdecimal() and len(window) <= digits_max and 2 <= int(window) <= WINDOW_MAX
