"""The figures of a report on one trace or CSV file, each computed once, and the charts with their captions.

The charts are drawn in `charts.py`.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from offboard.loadgen.replay import replay
from offboard.loadgen.replay.replay_settings import ReplayConfig
from offboard.loadgen.report import chart_data
from offboard.loadgen.report.chart_data import POINTS_MAX, Accuracies, Times
from offboard.loadgen.table import table_two
from offboard.loadgen.table.measured_rows import Lived, NoOneTable, Rows, is_csv, read_lived
from offboard.loadgen.table.measurement_notes import read_noted
from offboard.loadgen.table.table_formats import Table
from offboard.loadgen.table.table_settings import TableConfig
from offboard.loadgen.table.table_two import Evaluation
from offboard.loadgen.table.table_two_figures import Score
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

NO_WINDOW = "Not drawn: there are too few rows to fill any window and predict the next row."


class Findings:
    """The figures of `source`.

    `table` names the predictors; `replay` names the policies, and their predictor, window, feedback and seed.
    `evaluated` holds a table for each feedback mode of `table`; everything else has the mode of `replay`.
    `no_table` says why the tasks fit no table; it is empty if they do.
    """

    def __init__(self, source: Path, table: TableConfig, replay: ReplayConfig) -> None:
        self._source = source
        self._table = table
        self.settings = replay.as_in_the_run(source)
        self.no_table = ""
        self.lived, self.rows = Lived(np.empty(0), np.empty(0, dtype=bool)), Rows(*np.empty((3, 0)))
        try:
            self.lived = read_lived(source, replay.kind)
            self.rows = read_noted(source, replay.kind, least=0 if len(self.lived.waited_s) else 1)
        except NoOneTable as reason:  # the live page still shows the tasks
            self.no_table = str(reason)

    @property
    def for_paper(self) -> bool:
        """Whether there are rows for the charts and tables of the paper: more than a warm-up in a trace."""
        return is_csv(self._source) or len(self.rows) > self.settings.length

    @cached_property
    def times(self) -> Times | None:
        """The chart of execution times; None if no task ran on both sites."""
        return chart_data.times(self.rows, self.settings.seed) if len(self.rows) else None

    @cached_property
    def evaluated(self) -> list[Table]:
        """Table II; no tables if no task ran on both sites."""
        return table_two.tables(self._source, self.rows, self._table) if len(self.rows) else []

    @property
    def scores(self) -> list[Score]:
        """The rows of Table II that have a score: first the predictors, then the constant policies."""
        mode = self.settings.feedback
        tables = [table for table in self.evaluated if table.about["feedback"] == mode]
        return [line for table in tables for line in table.lines if line.scored]

    @cached_property
    def accuracies(self) -> Accuracies | None:
        """The chart of accuracy; None if no window leaves a row to predict."""
        settings = self.settings
        predicted = [score for score in self.scores if score.predictor]
        if not predicted:
            return None
        own = [score for score in predicted if score.predictor == settings.predictor]
        evaluation = Evaluation(self.rows, self._table)
        intervals = chart_data.accuracy_intervals(evaluation, own, settings.feedback, settings.seed)
        return Accuracies(predicted, intervals, [score for score in self.scores if not score.predictor])

    @cached_property
    def replayed(self) -> Table:
        """The figures of each policy, and of the run as recorded."""
        (table,) = replay.tables(self._source, self.settings)
        return table


@dataclass(frozen=True, slots=True)
class Chart:
    """One chart of a report.

    `shown` is the data for `charts.draw`. None: the chart cannot be drawn, for the reason in the caption.
    """

    name: str
    title: str
    caption: str
    shown: Any = None


def all_charts(findings: Findings) -> list[Chart]:
    return [_times(findings), _errors(findings), _accuracy(findings)]


def _times(findings: Findings) -> Chart:
    name, title, shown, count = "times", "Execution time by input size", findings.times, len(findings.rows)
    if shown is None:
        return Chart(name, title, "Not drawn: no task ran on both sites.")
    thinned = f" {POINTS_MAX:,} of {count:,} points are drawn." if count > POINTS_MAX else ""
    first = "" if findings.rows.more is None else " The size is the first number of each."
    caption = (
        f"The same {count:,} tasks on both sites.{first} The lines are least-squares fits over all of them. "
        f"{_crossing(shown)}{thinned}"
    )
    return Chart(name, title, caption, shown)


def _errors(findings: Findings) -> Chart:
    name, title = "errors", "Prediction error by window size"
    shown = [score for score in findings.scores if None not in (score.onboard_mae_s, score.cloud_mae_s)]
    if not shown:
        return Chart(name, title, NO_WINDOW)
    caption = (
        "The mean absolute error (MAE) of the predictions, and the residual without its sign. "
        "The residual is a difference of two means, so positive and negative errors cancel. "
        f"{_every_n(findings)}."
    )
    return Chart(name, title, caption, shown)


def _accuracy(findings: Findings) -> Chart:
    name, title, shown = "accuracy", "Accuracy by window size", findings.accuracies
    if shown is None:
        return Chart(name, title, NO_WINDOW)
    caption = (
        "The share of tasks that were sent to the site that was really faster. "
        f"The band is the 95 % interval for {findings.settings.predictor}. "
        "The figures in the paper come from other computers. "
        f"Level lines are policies that do not predict, over all rows. {_every_n(findings)}."
    )
    return Chart(name, title, caption, shown)


def _crossing(times: Times) -> str:
    if times.low == times.high:
        return "They are level, because all tasks have the same size."
    if times.crossing is None:
        return "They are parallel."
    at = f"d = {times.crossing:.4g}"
    if not times.crossing_inside:
        faster = ONBOARD if times.onboard.mean_seconds < times.cloud.mean_seconds else CLOUD
        return f"They cross at {at}, outside the measured sizes: {faster} is faster on average."
    small, large = (ONBOARD, CLOUD) if times.onboard.slope > times.cloud.slope else (CLOUD, ONBOARD)
    return f"They cross at {at}: on average, {small} is faster for smaller tasks and {large} for larger ones."


def _every_n(findings: Findings) -> str:
    names = list(dict.fromkeys(score.predictor for score in findings.scores if score.predictor))
    predictors = f"predictor{'s' if len(names) > 1 else ''} {', '.join(names)}"
    return f"{len(findings.rows):,} rows for every N; {predictors}; feedback {findings.settings.feedback}"
