"""Files of measured times for the tests of reports, and the names of the charts of the paper."""

from pathlib import Path

from tests.table_loops import Line, csv_of

CHARTS = ("times", "errors", "accuracy")


def write_rows(folder: Path, rows: list[Line]) -> Path:
    """Write rows.csv."""
    path = folder / "rows.csv"
    path.write_text(csv_of(rows))
    return path
