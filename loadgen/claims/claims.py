"""`loadgen claims`: one line for each claim of the paper, next to our own figure, for each dataset.

The other files of this folder compute the lines. docs/claims.md explains them.
"""

import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from operator import attrgetter
from pathlib import Path

from offboard.loadgen.claims.claim import HEADINGS, Claim, ClaimsConfig
from offboard.loadgen.claims.computing_time import ROUNDS, computing_time
from offboard.loadgen.claims.correlation_claims import sample_order, significance
from offboard.loadgen.claims.disturbed_claims import lasting_loads, no_correlation_and_outliers
from offboard.loadgen.claims.prediction_claims import (
    K_MEANS,
    RIVALS,
    Inputs,
    PredictionClaims,
    read_inputs,
    several_inputs,
)
from offboard.loadgen.claims.site_claims import r_by_site, r_by_window, slopes
from offboard.loadgen.claims.verdicts import verdicts
from offboard.loadgen.progress import Progress, progress
from offboard.loadgen.table.measured_rows import Rows
from offboard.loadgen.table.measurement_notes import read_noted
from offboard.loadgen.table.table_columns import ColumnSettings
from offboard.loadgen.table.table_formats import Table

MORE = {  # for each claim, the command that shows more of it
    2: "loadgen table {file} --columns r_cloud,r_onboard --bootstrap",
    8: "loadgen table {file} --feedback both --bootstrap --all",
    9: "loadgen table {file} --bootstrap",
    12: "loadgen table {file} --windows full --predictors all --bootstrap",
    13: "python -m benchmarks decision",
    16: "loadgen table {file} --predictors k-means,least-squares --bootstrap",
    17: "loadgen replay {file} --policies paper,onboard,cloud --bootstrap",
}

FIRST_ONLY = "All lines here use the first number of each size only."


def run_claims(paths: Sequence[Path], config: ClaimsConfig) -> int:
    """Print one table for each dataset to stdout."""
    # All files first, so that mistakes show at once.
    read = [(path, by_first_number(read_noted(path, config.kind)), read_inputs(path)) for path in paths]
    with progress("claims", len(paths) * _steps(config)) as shown:
        tables = [_table(path, rows, claims(rows, inputs, config, shown)) for path, rows, inputs in read]
    if config.verdicts:
        tables = [verdicts(tables)]
    sys.stdout.write(ColumnSettings(format=config.format).text(tables))
    return 0


def by_first_number(rows: Rows) -> Rows:
    """The claims are about sizes of one number."""
    first = rows.by_first_number()
    return rows if first is None else replace(first, notes=(*rows.notes, FIRST_ONLY))


def _table(path: Path, rows: Rows, found: Iterator[Claim]) -> Table:
    lines = [replace(one, more=MORE.get(one.number, "docs/claims.md").format(file=path)) for one in found]
    lines.sort(key=attrgetter("number"))
    return Table(
        caption=f"{path}: {rows.counted()}. The numbers are those of the claims in docs/claims.md.",
        about=rows.about(path),
        headings=HEADINGS,
        lines=lines,
        notes=(
            *rows.notes,
            *(f"More of {number}: {more.format(file=path)}" for number, more in MORE.items()),
        ),
    )


def claims(rows: Rows, inputs: Inputs | None, config: ClaimsConfig, shown: Progress) -> Iterator[Claim]:
    """The lines of one dataset, by claim."""
    of_predictions = PredictionClaims(rows, config)
    yield from significance(rows, config)
    yield from r_by_window(rows, config)
    yield r_by_site(rows, config)
    yield slopes(rows, config)
    shown.step()
    yield from sample_order(rows, config)
    yield from lasting_loads(rows, config)
    shown.step()
    yield from of_predictions.errors()
    yield from of_predictions.accuracy()
    shown.step()
    compared = []
    for name in config.rivals():
        compared.append(of_predictions.rival(name))
        shown.step()
    yield from (one for one in compared if one.number == RIVALS)
    yield from computing_time(rows, config, shown.step)
    yield from no_correlation_and_outliers(rows, config)
    yield from several_inputs(inputs, rows, config)
    yield from (one for one in compared if one.number == K_MEANS)
    yield from of_predictions.saving()


def _steps(config: ClaimsConfig) -> int:
    """How often `claims` steps."""
    return 3 + len(config.rivals()) + ROUNDS + 1
