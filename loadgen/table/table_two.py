"""`loadgen table`: the paper's Table II, with more figures than the paper has, from measured rows.

Predictors are evaluated by a replay of Algorithm 1. `table_two_figures` computes the figures.
"""

import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache, partial
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from offboard.common.errors import MissingExtra
from offboard.common.tasks import Kind, Size
from offboard.loadgen import rivals
from offboard.loadgen.progress import progress
from offboard.loadgen.table import confidence_intervals
from offboard.loadgen.table.confidence_intervals import Picks
from offboard.loadgen.table.measured_rows import FIRST_NUMBER, Column, Rows
from offboard.loadgen.table.measurement_notes import read_noted
from offboard.loadgen.table.table_formats import Table
from offboard.loadgen.table.table_settings import ALL, CHOSEN, FULL, FULL_WINDOW, NONE, TableConfig
from offboard.loadgen.table.table_two_figures import (
    FIRST,
    HEADINGS,
    PUBLISHED,
    Score,
    Scored,
    figures,
    mean_r,
    plain,
)
from offboard.robot_client import predictors
from offboard.robot_client.learning.memories import Memories
from offboard.robot_client.learning.site import SiteMemory
from offboard.robot_client.sites.runner import CLOUD, NOTHING, ONBOARD, UNMEASURED, Execution

ROW = Kind("row", function=float, size=float)
SITES: tuple[str, ...] = (ONBOARD, CLOUD)
THE_PAPER = "the paper"


def run_table(path: Path, config: TableConfig) -> int:
    """Print the tables of `path` to stdout."""
    config.check_columns(HEADINGS)
    sys.stdout.write(config.text(read_tables(path, config)))
    return 0


def read_tables(path: Path, config: TableConfig) -> list[Table]:
    return tables(path, read_noted(path, config.kind), config)


def tables(path: Path, rows: Rows, config: TableConfig) -> list[Table]:
    """One table for each feedback mode."""
    evaluation, modes = Evaluation(rows, config), config.modes()
    with progress("predictors and windows", len(modes) * len(planned(config))) as shown:
        scores = {mode: list(evaluation.scores(mode, shown.step)) for mode in modes}
    return [_table(path, rows, config, scores[mode], feedback=mode) for mode in modes]


def _table(path: Path, rows: Rows, config: TableConfig, scores: list[Score], *, feedback: str) -> Table:
    names = tuple(dict.fromkeys(one.predictor for one in scores if one.predictor))
    if config.published:
        scores = list(_with_printed(scores))
    about = f"predictor{'s' if len(names) > 1 else ''} {', '.join(names)}, feedback {feedback}"
    hidden = {"predictor": len(names) <= 1 and not config.published, "bound": not config.bootstrap}
    return Table(
        caption=f"{path}: {rows.counted()}, {about}.",
        about={**rows.about(path), "feedback": feedback},
        headings={name: heading for name, heading in HEADINGS.items() if not hidden.get(name)},
        lines=scores,
        notes=rows.notes,
        first=FIRST,
    )


def _with_printed(scores: Sequence[Score]) -> Iterator[Score]:
    """After the lines of least squares for each N, what the paper printed for it."""
    for window, lines in groupby(scores, attrgetter("window")):
        found = list(lines)
        yield from found
        of_least_squares = any(line.predictor.startswith(predictors.LEAST_SQUARES) for line in found)
        if of_least_squares and window in PUBLISHED:
            yield replace(PUBLISHED[window], predictor=THE_PAPER)


class Evaluation:
    """Predictors and constant rules, replayed over `rows`."""

    def __init__(self, rows: Rows, config: TableConfig) -> None:
        self._rows = rows
        self._config = config
        first = rows.by_first_number()
        self._by_first_number = None if first is None else Evaluation(first, config)
        # These are the same for every table, so they are computed once.
        self._split = cache(self._find_split)
        self._correlations = cache(self._find_correlations)
        self._correlation_ends = cache(self._find_correlation_ends)
        self._blocks = cache(config.blocks)

    def scores(self, feedback: str, step: Callable[[], object] = lambda: None) -> Iterator[Score]:
        """The lines of one table: each predictor with each window, then the constant rules.

        `step` is called after each of `planned`.
        """
        for name, window in planned(self._config):
            yield from self._predictor_scores(name, window, feedback)
            if self._by_first_number is not None and rivals.takes_several_numbers(name):
                for line in self._by_first_number._predictor_scores(name, window, feedback):
                    yield replace(line, predictor=FIRST_NUMBER.format(name))
            step()
        rows = self._rows
        oracle = rows.cloud_s < rows.onboard_s
        for rule, to_cloud in (
            ("always-onboard", np.zeros_like(oracle)),
            ("always-cloud", np.ones_like(oracle)),
            ("oracle", oracle),
        ):
            yield from self._lines(Score("", rule), Scored(rows.onboard_s, rows.cloud_s, to_cloud))

    def predictions(self, name: str, window: str, feedback: str) -> Scored | None:
        """The rows after the first N (full: after the first 80 %), with predictions.

        None if no row is left.
        """
        length = self._length(window)
        if length < 2 or length >= len(self._rows):
            return None
        full = window == FULL_WINDOW
        predicted = self._split(name) if full else self._predict(name, length, feedback)
        return Scored.predicted(self._rows.since(length), *predicted)

    def _predictor_scores(self, name: str, window: str, feedback: str) -> Iterator[Score]:
        try:
            scored = self.predictions(name, window, feedback)
        except MissingExtra as error:
            if ALL not in self._config.predictors:
                raise
            yield Score(name, window, note=str(error))
            return
        if scored is None:
            yield Score(name, window, note="not enough rows")
        else:
            # The length of the sliding windows over which r is computed.
            correlated = len(self._rows) if window == FULL_WINDOW else int(window)
            yield from self._lines(Score(name, window), scored, correlated)

    def _length(self, window: str) -> int:
        return len(self._rows) * 4 // 5 if window == FULL_WINDOW else int(window)

    def _predict(self, name: str, length: int, feedback: str) -> tuple[Column, Column]:
        return predict(self._rows, length, predictor=name, feedback=feedback, seed=self._config.seed)

    def _find_split(self, name: str) -> tuple[Column, Column]:
        """The predictions for full: in both feedback modes, nothing is learnt after the split."""
        return self._predict(name, self._length(FULL_WINDOW), NONE)

    def _lines(self, line: Score, scored: Scored, correlated: int | None = None) -> Iterator[Score]:
        """The figures, and with --bootstrap the ends of their intervals."""
        count = len(scored.to_cloud)
        found = plain(figures(scored)) | self._correlations(correlated)
        yield replace(line, scored=count, **found)
        if self._config.bootstrap:
            ends = self._blocks(count).intervals(lambda picks: figures(scored.picked(picks)))
            r_ends = self._correlation_ends(correlated)
            for bound, end, r_end in zip(confidence_intervals.BOUNDS, ends, r_ends, strict=True):
                yield replace(line, scored=count, bound=bound, **end, **r_end)

    def _find_correlations(self, length: int | None) -> dict[str, Any]:
        if length is None or self._rows.more is not None:
            return {}
        rows = self._rows
        return {
            "r_cloud": mean_r(rows.size, rows.cloud_s, length),
            "r_onboard": mean_r(rows.size, rows.onboard_s, length),
        }

    def _find_correlation_ends(self, length: int | None) -> tuple[dict[str, Any], ...]:
        if length is None or self._rows.more is not None:
            return ({},) * len(confidence_intervals.BOUNDS)
        rows = self._rows

        def both(picks: Picks) -> dict[str, Column]:
            size = rows.size[picks]
            return {
                "r_cloud": confidence_intervals.mean_r(size, rows.cloud_s[picks], length),
                "r_onboard": confidence_intervals.mean_r(size, rows.onboard_s[picks], length),
            }

        return self._blocks(len(rows)).intervals(both)


def planned(config: TableConfig) -> list[tuple[str, str]]:
    """Each predictor with each of its windows; a slow one has only full, unless all are asked for."""
    return [
        (name, window)
        for name in config.names()
        for window in config.windows
        if config.every_window or window == FULL_WINDOW or not rivals.slow(name)
    ]


def predict(rows: Rows, length: int, *, predictor: str, feedback: str, seed: int) -> tuple[Column, Column]:
    """The predicted onboard and cloud times of every row after the first `length`; both sites learn those.

    The memory of a robot asks and teaches the predictors, so that a robot with these times predicts the same.
    """
    memory = Memories(partial(rivals.make, predictor, length, seed)).of(ROW, SITES)
    predicted = np.empty((2, len(rows) - length))
    triples = zip(rows.sizes(), rows.onboard_s.tolist(), rows.cloud_s.tolist(), strict=True)
    for at, (size, onboard_s, cloud_s) in enumerate(triples, start=-length):
        learning = SITES
        if at >= 0:
            p_onboard, p_cloud = (_seconds(memory.site(site), size) for site in SITES)
            predicted[:, at] = p_onboard, p_cloud
            # Eq. 1; a tie stays onboard.
            chosen = CLOUD if p_cloud < p_onboard else ONBOARD
            learning = {FULL: SITES, CHOSEN: (chosen,), NONE: ()}[feedback]
        memory.count_task()
        for site, seconds in ((ONBOARD, onboard_s), (CLOUD, cloud_s)):
            if site in learning:
                memory.site(site).learn(size, Execution(site, seconds), None, silent=False, size=size)
    return predicted[0], predicted[1]


def _seconds(memory: SiteMemory, size: Size) -> float:
    outlook = memory.outlook(size, UNMEASURED, in_flight=0, sending=NOTHING)
    assert outlook.predicted_s is not None, "a predictor that has learnt something can predict"
    return outlook.predicted_s
