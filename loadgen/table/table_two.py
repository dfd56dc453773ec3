"""`loadgen table`: prints the paper's Table II, with more figures than the paper has, from measured rows.

`predictor_evaluation` computes the lines of the tables.
"""

import sys
from pathlib import Path

from offboard.loadgen.progress import progress
from offboard.loadgen.table.measured_rows import Rows
from offboard.loadgen.table.measurement_notes import read_noted
from offboard.loadgen.table.predictor_evaluation import Evaluation, planned
from offboard.loadgen.table.table_formats import Table, render
from offboard.loadgen.table.table_settings import TableConfig
from offboard.loadgen.table.table_two_figures import FIRST, HEADINGS, Score


def run_table(path: Path, config: TableConfig) -> int:
    """Print the tables of `path` to stdout."""
    config.check_columns(HEADINGS, config.format)
    sys.stdout.write(config.text(read_tables(path, config), config.format))
    return 0


def table_text(path: Path, config: TableConfig) -> str:
    """The tables of a trace or a CSV dataset with all columns, in the chosen format."""
    return render(read_tables(path, config), config.format)


def read_tables(path: Path, config: TableConfig) -> list[Table]:
    """The tables of a trace or a CSV dataset."""
    return tables(path, read_noted(path, config.kind), config)


def tables(path: Path, rows: Rows, config: TableConfig) -> list[Table]:
    """One table for each feedback mode."""
    evaluation, modes = Evaluation(rows, config), config.modes()
    with progress("predictors and windows", len(modes) * len(planned(config))) as shown:
        scores = {mode: list(evaluation.scores(mode, shown.step)) for mode in modes}
    return [_table(path, rows, config, scores[mode], feedback=mode) for mode in modes]


def _table(path: Path, rows: Rows, config: TableConfig, scores: list[Score], *, feedback: str) -> Table:
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
        first=FIRST,
    )
