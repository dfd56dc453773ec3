"""`loadgen table`: the paper's Table II from rows with both times, and what the paper leaves out."""

import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from offboard.common.config import check, setting
from offboard.common.errors import ConfigError, MissingExtra
from offboard.loadgen.table import bootstrap
from offboard.loadgen.table.bootstrap import Blocks, Picks
from offboard.loadgen.table.notes import read_noted
from offboard.loadgen.table.render import FORMATS, Table, render
from offboard.loadgen.table.rows import Column, Rows
from offboard.loadgen.table.score import HEADINGS, Score, Scored, figures, mean_r, plain
from offboard.robot_client import predictors
from offboard.robot_client.predictors.window import WINDOW_MAX

CHOSEN, FULL, NONE, BOTH = "chosen", "full", "none", "both"
FULL_WINDOW = "full"  # the paper's last line: fit once on the first 80 %, not a feedback mode
PAPER_WINDOWS = ("5", "10", "20", "30", "40", "50", "75", "100", "500", FULL_WINDOW)
ALL = "all"


@dataclass(frozen=True)
class Asked:
    """What is asked alike of `table` and `replay`."""

    feedback: str = setting(
        CHOSEN,
        "who learns after warm-up: the site that ran the task, every site (full), or a table of each (both)",
        choices=(CHOSEN, FULL, BOTH),
    )
    bootstrap: bool = setting(False, "a 95 % interval of each figure, over blocks of neighbouring rows")
    block: int | None = setting(
        None, "rows in a block of the bootstrap; without it the square root of the rows", minimum=1
    )
    seed: int = setting(1, "of the bootstrap and of predictors that draw", minimum=0)
    format: str = setting("md", "output format", choices=FORMATS)
    kind: str | None = setting(None, "kind of task, where a trace holds several")

    def modes(self) -> tuple[str, ...]:
        """The feedback modes, a table each."""
        return (CHOSEN, FULL) if self.feedback == BOTH else (self.feedback,)

    def blocks(self, rows: int) -> Blocks:
        """The resamples of a table of so many rows."""
        return Blocks(rows, length=self.block, seed=self.seed)


@dataclass(frozen=True)
class TableConfig(Asked):
    """What to print; every predictor with every window in every feedback mode."""

    windows: tuple[str, ...] = setting(
        PAPER_WINDOWS, "window lengths N; full: fit on the first 80 %, scored on the rest", metavar="N,N,.."
    )
    predictors: tuple[str, ...] = setting(
        (predictors.LEAST_SQUARES,), f"{predictors.HELP}; or {ALL}", metavar="NAME,NAME,.."
    )
    every_window: bool = setting(
        False,
        "slow predictors (forest, ARIMA, SARIMA, LSTM) with every N too, not at full alone: may take an hour",
    )

    def __post_init__(self) -> None:
        check(self)
        for window in self.windows:
            if window != FULL_WINDOW and not _is_length(window):
                allowed = f"a whole number from 2 to {WINDOW_MAX} nor {FULL_WINDOW}"
                raise ConfigError(f"--windows: {window!r} is neither {allowed}")
        for name in self.predictors:
            if name != ALL:
                predictors.check_name(name, "--predictors")

    def names(self) -> tuple[str, ...]:
        """The predictors by name, each once."""
        named = (predictors.names() if name == ALL else (name,) for name in self.predictors)
        return tuple(dict.fromkeys(name for group in named for name in group))


def run_table(path: Path, config: TableConfig) -> int:
    """Print the tables of `path` to stdout."""
    sys.stdout.write(table_text(path, config))
    return 0


def table_text(path: Path, config: TableConfig) -> str:
    """The tables of a trace or CSV, in the format asked for."""
    return render(tables(path, read_noted(path, config.kind), config), config.format)


def tables(path: Path, rows: Rows, config: TableConfig) -> list[Table]:
    """One table a feedback mode."""
    evaluation = Evaluation(rows, config)
    return [_table(path, rows, config, mode, list(evaluation.scores(mode))) for mode in config.modes()]


class Evaluation:
    """Predictors and constant rules replayed over `rows`."""

    def __init__(self, rows: Rows, config: TableConfig) -> None:
        self._rows = rows
        self._config = config
        # The same for every table: the split, the correlations and the resamples.
        self._split = cache(self._find_split)
        self._correlations = cache(self._find_correlations)
        self._correlation_ends = cache(self._find_correlation_ends)
        self._blocks = cache(config.blocks)

    def scores(self, feedback: str) -> Iterator[Score]:
        """The lines of one table: each predictor with each window, then the rules that predict nothing."""
        for name in self._config.names():
            yield from self._predictor_scores(name, feedback)
        oracle = self._rows.cloud_s < self._rows.onboard_s
        for rule, to_cloud in (
            ("always-onboard", np.zeros_like(oracle)),
            ("always-cloud", np.ones_like(oracle)),
            ("oracle", oracle),
        ):
            yield from self._lines(
                Score("", rule), Scored(self._rows.onboard_s, self._rows.cloud_s, to_cloud)
            )

    def predictions(self, name: str, window: str, feedback: str) -> Scored | None:
        """The rows after the first N (full: the first 80 %), predicted; None where none are left."""
        length = self._length(window)
        if length < 2 or length >= len(self._rows):
            return None
        if window == FULL_WINDOW:
            onboard_s, cloud_s = self._split(name)
        else:
            onboard_s, cloud_s = predict(self._rows, length, name, feedback, self._config.seed)
        scored = self._rows.since(length)
        # Eq. 1; a tie stays onboard.
        return Scored(scored.onboard_s, scored.cloud_s, cloud_s < onboard_s, onboard_s, cloud_s)

    def _predictor_scores(self, name: str, feedback: str) -> Iterator[Score]:
        for window in self._config.windows:
            if predictors.slow(name) and window != FULL_WINDOW and not self._config.every_window:
                continue
            try:
                scored = self.predictions(name, window, feedback)
            except MissingExtra as error:
                if ALL not in self._config.predictors:
                    raise
                yield Score(name, window, note=str(error))
                continue
            if scored is None:
                yield Score(name, window, note="not enough rows")
            else:
                yield from self._lines(Score(name, window), scored, self._correlated(window))

    def _length(self, window: str) -> int:
        return len(self._rows) * 4 // 5 if window == FULL_WINDOW else int(window)

    def _correlated(self, window: str) -> int:
        """Rows of the sliding windows over which r is taken; all of them at full."""
        return len(self._rows) if window == FULL_WINDOW else int(window)

    def _find_split(self, name: str) -> tuple[Column, Column]:
        """The same in both feedback modes: nothing is learnt after the split."""
        return predict(self._rows, self._length(FULL_WINDOW), name, NONE, self._config.seed)

    def _lines(self, line: Score, scored: Scored, correlated: int | None = None) -> Iterator[Score]:
        """The figures, and the ends of their intervals where those are asked for."""
        count = len(scored.to_cloud)
        found = plain(figures(scored)) | self._correlations(correlated)
        yield replace(line, scored=count, **found)
        if self._config.bootstrap:
            ends = self._blocks(count).intervals(lambda picks: figures(scored.picked(picks)))
            r_ends = self._correlation_ends(correlated)
            for bound, end, r_end in zip(bootstrap.BOUNDS, ends, r_ends, strict=True):
                yield replace(line, scored=count, bound=bound, **end, **r_end)

    def _find_correlations(self, length: int | None) -> dict[str, Any]:
        if length is None:
            return {}
        rows = self._rows
        return {
            "r_cloud": mean_r(rows.size, rows.cloud_s, length),
            "r_onboard": mean_r(rows.size, rows.onboard_s, length),
        }

    def _find_correlation_ends(self, length: int | None) -> tuple[dict[str, Any], ...]:
        if length is None:
            return ({},) * len(bootstrap.BOUNDS)
        rows = self._rows

        def both(picks: Picks) -> dict[str, Column]:
            size = rows.size[picks]
            return {
                "r_cloud": bootstrap.mean_r(size, rows.cloud_s[picks], length),
                "r_onboard": bootstrap.mean_r(size, rows.onboard_s[picks], length),
            }

        return self._blocks(len(rows)).intervals(both)


def predict(rows: Rows, length: int, predictor: str, moving: str, seed: int) -> tuple[Column, Column]:
    """Predicted onboard and cloud times of every row after the first `length`, which both sites learn."""
    onboard, cloud = (predictors.make(predictor, length, seed) for _ in range(2))
    triples = list(zip(rows.size.tolist(), rows.onboard_s.tolist(), rows.cloud_s.tolist(), strict=True))
    for size, onboard_s, cloud_s in triples[:length]:
        onboard.learn(size, onboard_s)
        cloud.learn(size, cloud_s)
    predicted = np.empty((2, len(triples) - length))
    onboard_ahead = cloud_ahead = 1
    for at, (size, onboard_s, cloud_s) in enumerate(triples[length:]):
        p_onboard, p_cloud = _seconds(onboard, size, onboard_ahead), _seconds(cloud, size, cloud_ahead)
        predicted[:, at] = p_onboard, p_cloud
        to_cloud = p_cloud < p_onboard  # Eq. 1; a tie stays onboard
        onboard_ahead += 1
        cloud_ahead += 1
        if moving == FULL or (moving == CHOSEN and not to_cloud):
            onboard.learn(size, onboard_s)
            onboard_ahead = 1
        if moving == FULL or (moving == CHOSEN and to_cloud):
            cloud.learn(size, cloud_s)
            cloud_ahead = 1
    return predicted[0], predicted[1]


def _seconds(predictor: predictors.Predictor, size: float, ahead: int) -> float:
    prediction = predictor.predict(size, ahead)
    assert prediction is not None, "a predictor that has learnt predicts"
    return prediction.seconds


def _table(path: Path, rows: Rows, config: TableConfig, feedback: str, scores: list[Score]) -> Table:
    names = config.names()
    about = f"predictor{'s' if len(names) > 1 else ''} {', '.join(names)}, feedback {feedback}"
    left_out = f" ({rows.left_out} tasks without both times left out)" if rows.left_out else ""
    hidden = {"predictor": len(names) == 1, "bound": not config.bootstrap}
    return Table(
        caption=f"{path}: {len(rows)} rows{left_out}, {about}.",
        about={"source": str(path), "rows": len(rows), "left_out": rows.left_out, "feedback": feedback},
        headings={name: heading for name, heading in HEADINGS.items() if not hidden.get(name)},
        lines=scores,
        notes=rows.notes,
    )


def _is_length(window: str) -> bool:
    digits_max = len(str(WINDOW_MAX))
    return window.isdecimal() and len(window) <= digits_max and 2 <= int(window) <= WINDOW_MAX
