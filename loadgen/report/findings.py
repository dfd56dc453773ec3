"""The figures of a report on one trace or CSV file, each computed once.

Captions and charts are left to `captions.py` and `charts.py`.
"""

from functools import cached_property
from pathlib import Path

from offboard.loadgen.replay import replay
from offboard.loadgen.replay.dataset_file import measured_tasks, read_recorded
from offboard.loadgen.replay.replay import ORACLE, RECORDED, ReplayConfig, Replayed
from offboard.loadgen.report import chart_data
from offboard.loadgen.report.chart_data import Accuracies, Decisions, Times
from offboard.loadgen.table import table_two
from offboard.loadgen.table.measured_rows import Column, read_lived
from offboard.loadgen.table.measurement_notes import read_noted
from offboard.loadgen.table.predictor_evaluation import Evaluation
from offboard.loadgen.table.table_formats import Table
from offboard.loadgen.table.table_settings import TableConfig
from offboard.loadgen.table.table_two_figures import Score


class Findings:
    """The figures of `source`.

    `table` names the predictors; `replay` names the policies, and their predictor, window, feedback and seed.
    `evaluated` holds a table for each feedback mode of `table`; everything else has the mode of `replay`.
    """

    def __init__(self, source: Path, table: TableConfig, replay: ReplayConfig) -> None:
        self._source = source
        self._table = table
        self.settings = replay.as_in_the_run(source)
        self.lived = read_lived(source, replay.kind)
        self.rows = read_noted(source, replay.kind, least=0 if len(self.lived.waited_s) else 1)
        self.scored = self.rows.since(replay.length)

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
        wanted = self.settings.feedback
        lines = [
            line for table in self.evaluated if table.about["feedback"] == wanted for line in table.lines
        ]
        return [line for line in lines if line.scored]

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

    @cached_property
    def decisions(self) -> Decisions | None:
        """The recorded decisions, or else those of the first policy; None if there are neither."""
        settings, lived = self.settings, self.lived
        if len(lived.waited_s):
            return chart_data.decisions(RECORDED, lived.waited_s, lived.to_cloud, first=1, seed=settings.seed)
        if not len(self.scored):
            return None
        policy = settings.policies[0]
        return chart_data.decisions(
            policy,
            self._played[policy].spent_s,
            self._played[policy].to_cloud,
            first=settings.length + 1,
            seed=settings.seed,
            best=self._best.to_cloud,
        )

    @property
    def spent_s(self) -> dict[str, Column]:
        """The times of the rows after the warm-up, by policy; the run as recorded has other tasks."""
        found = {policy: played.spent_s for policy, played in self._played.items()}
        if found:
            found[ORACLE] = self._best.spent_s
        return found | ({RECORDED: self.lived.waited_s} if len(self.lived.waited_s) else {})

    @cached_property
    def _played(self) -> dict[str, Replayed]:
        """What became of the rows after the warm-up, by policy; empty if there are no such rows."""
        if not len(self.scored):
            return {}
        settings = self.settings
        tasks = measured_tasks(read_recorded(self._source, settings.kind))
        return {
            policy: replay.replay(tasks, policy, settings, feedback=settings.feedback)
            for policy in settings.policies
        }

    @property
    def _best(self) -> Replayed:
        return replay.best(self.scored)
