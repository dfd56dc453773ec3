"""`loadgen table`: Table II of the paper from rows with both times, and what the paper leaves out beside it.

Every column is explained, and worked out by hand on 12 rows, in docs/evaluation.md.
"""

import math
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from numpy.lib.stride_tricks import sliding_window_view

from common.config import check, setting
from common.errors import ConfigError
from loadgen.render import FORMATS, Score, Table, render
from loadgen.rows import Column, Rows, read
from robot_client import predictors
from robot_client.window import WINDOW_MAX

CHOSEN, FULL, NONE, BOTH = "chosen", "full", "none", "both"
FULL_WINDOW = "full"  # the paper's last line: fit once on the first 80 %, not a feedback mode
PAPER_WINDOWS = ("5", "10", "20", "30", "40", "50", "75", "100", "500", FULL_WINDOW)
BLOCK_CELLS_MAX = 1_000_000  # sliding windows held in memory at once, in cells

Sides = npt.NDArray[np.bool_]  # True: the task went to the cloud


@dataclass(frozen=True)
class TableConfig:
    """What to print; every window with every predictor in every feedback mode."""

    windows: tuple[str, ...] = setting(
        PAPER_WINDOWS, "window lengths N; full: fit on the first 80 %, scored on the rest", metavar="N,N,.."
    )
    predictors: tuple[str, ...] = setting(
        (predictors.LEAST_SQUARES,), "one table each", choices=predictors.names()
    )
    feedback: str = setting(
        CHOSEN,
        "whose window moves after warm-up: the chosen site's, every site's (full), or a table of each (both)",
        choices=(CHOSEN, FULL, BOTH),
    )
    format: str = setting("md", "output format", choices=FORMATS)
    kind: str | None = setting(None, "kind of task, where a trace holds several")

    def __post_init__(self) -> None:
        check(self)
        for window in self.windows:
            if window != FULL_WINDOW and not _is_length(window):
                allowed = f"a whole number from 2 to {WINDOW_MAX} nor {FULL_WINDOW}"
                raise ConfigError(f"--windows: {window!r} is neither {allowed}")


def run_table(path: Path, config: TableConfig) -> int:
    """Print the tables of `path` to stdout."""
    sys.stdout.write(table_text(path, config))
    return 0


def table_text(path: Path, config: TableConfig) -> str:
    """The tables of a trace or CSV, in the format asked for."""
    rows = read(path, config.kind)
    modes = (CHOSEN, FULL) if config.feedback == BOTH else (config.feedback,)
    tables = [
        Table(str(path), len(rows), rows.left_out, mode, name, _scores(rows, config.windows, name, mode))
        for mode in modes
        for name in config.predictors
    ]
    return render(tables, config.format)


def _is_length(window: str) -> bool:
    digits_max = len(str(WINDOW_MAX))
    return window.isdecimal() and len(window) <= digits_max and 2 <= int(window) <= WINDOW_MAX


def _scores(rows: Rows, windows: tuple[str, ...], predictor: str, feedback: str) -> tuple[Score, ...]:
    with_window = [_window_score(rows, window, predictor, feedback) for window in windows]
    oracle = rows.cloud_s < rows.onboard_s
    return (
        *with_window,
        _rule_score("always-onboard", rows, np.zeros_like(oracle)),
        _rule_score("always-cloud", rows, np.ones_like(oracle)),
        _rule_score("oracle", rows, oracle),
    )


def _window_score(rows: Rows, window: str, predictor: str, feedback: str) -> Score:
    """Trained on the first N rows (full: 80 %), scored on the rest."""
    if window == FULL_WINDOW:
        length, correlated, moving = len(rows) * 4 // 5, len(rows), NONE
    else:
        length, correlated, moving = int(window), int(window), feedback
    if length < 2 or length >= len(rows):
        return Score(window, note="not enough rows")
    onboard_s, cloud_s = _predict(rows, length, predictor, moving)
    scored = rows.since(length)
    return replace(
        _rule_score(window, scored, cloud_s < onboard_s),
        r_cloud=_mean_r(rows.size, rows.cloud_s, correlated),
        r_onboard=_mean_r(rows.size, rows.onboard_s, correlated),
        cloud_predicted_s=float(cloud_s.mean()),
        cloud_residual_s=float(cloud_s.mean() - scored.cloud_s.mean()),
        onboard_predicted_s=float(onboard_s.mean()),
        onboard_residual_s=float(onboard_s.mean() - scored.onboard_s.mean()),
        cloud_mae_s=float(np.abs(cloud_s - scored.cloud_s).mean()),
        onboard_mae_s=float(np.abs(onboard_s - scored.onboard_s).mean()),
        cloud_p95_s=_p95(np.abs(cloud_s - scored.cloud_s)),
        onboard_p95_s=_p95(np.abs(onboard_s - scored.onboard_s)),
    )


def _rule_score(window: str, rows: Rows, to_cloud: Sides) -> Score:
    """What sending these rows to these sides took, against the oracle; where times tie both are right."""
    spent_s = np.where(to_cloud, rows.cloud_s, rows.onboard_s)
    best_s = np.minimum(rows.cloud_s, rows.onboard_s)
    return Score(
        window,
        cloud_s=float(rows.cloud_s.mean()),
        onboard_s=float(rows.onboard_s.mean()),
        accuracy_percent=100 * float((spent_s == best_s).mean()),
        scored=len(rows),
        time_over_oracle=_ratio(float(spent_s.sum()), float(best_s.sum())),
        regret_s=float((spent_s - best_s).sum()),
        regret_mean_s=float((spent_s - best_s).mean()),
        cloud_percent=100 * float(to_cloud.mean()),
    )


def _predict(rows: Rows, length: int, predictor: str, moving: str) -> tuple[Column, Column]:
    """Predicted onboard and cloud times of every row after the first `length`, which both sides learn."""
    onboard, cloud = predictors.make(predictor, length), predictors.make(predictor, length)
    triples = list(zip(rows.size.tolist(), rows.onboard_s.tolist(), rows.cloud_s.tolist(), strict=True))
    for size, onboard_s, cloud_s in triples[:length]:
        onboard.learn(size, onboard_s)
        cloud.learn(size, cloud_s)
    predicted = np.empty((2, len(triples) - length))
    for at, (size, onboard_s, cloud_s) in enumerate(triples[length:]):
        p_onboard, p_cloud = _seconds(onboard, size), _seconds(cloud, size)
        predicted[:, at] = p_onboard, p_cloud
        to_cloud = p_cloud < p_onboard  # Eq. 1; a tie stays onboard
        if moving == FULL or (moving == CHOSEN and not to_cloud):
            onboard.learn(size, onboard_s)
        if moving == FULL or (moving == CHOSEN and to_cloud):
            cloud.learn(size, cloud_s)
    return predicted[0], predicted[1]


def _seconds(predictor: predictors.Predictor, size: float) -> float:
    prediction = predictor.predict(size)
    assert prediction is not None, "a predictor that has learnt predicts"
    return prediction.seconds


def _mean_r(sizes: Column, seconds: Column, length: int) -> float | None:
    """Mean Pearson r over all sliding windows of `length` rows in which neither column is constant."""
    d, t = sliding_window_view(sizes, length), sliding_window_view(seconds, length)
    step = max(1, BLOCK_CELLS_MAX // length)
    found = np.concatenate([_pearson(d[at : at + step], t[at : at + step]) for at in range(0, len(d), step)])
    return float(found.mean()) if len(found) else None


def _pearson(d: Column, t: Column) -> Column:
    """r of each row of `d` with that row of `t`, where defined."""
    varied = (np.ptp(d, axis=1) > 0) & (np.ptp(t, axis=1) > 0)
    d, t = _centred(d[varied]), _centred(t[varied])
    found: Column = (d * t).sum(axis=1) / np.sqrt((d * d).sum(axis=1) * (t * t).sum(axis=1))
    return found


def _centred(values: Column) -> Column:
    """Each row less its mean, scaled to at most 1: no digits cancel, no square over- or underflows."""
    centred: Column = values - values[:, :1]
    centred -= centred.mean(axis=1, keepdims=True)
    centred /= np.abs(centred).max(axis=1, keepdims=True)
    return centred


def _ratio(spent_s: float, best_s: float) -> float | None:
    ratio = spent_s / best_s if best_s > 0 else math.inf
    return ratio if math.isfinite(ratio) else None


def _p95(errors: Column) -> float:
    """Nearest rank: the least error that at least 95 % of the rows do not exceed."""
    return float(np.sort(errors)[-(-95 * len(errors) // 100) - 1])
