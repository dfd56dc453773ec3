"""`loadgen export`: writes the tasks of a trace that ran on both sites as a CSV dataset."""

from dataclasses import dataclass
from pathlib import Path

from offboard.common.config import REQUIRED, check, setting
from offboard.loadgen.table.measured_rows import read, write_csv


@dataclass(frozen=True)
class ExportConfig:
    """Which tasks of a trace are exported, and to which file."""

    csv: Path = setting(REQUIRED, "CSV file to write; an existing file is replaced", metavar="FILE")
    kind: str | None = setting(None, "kind of task to export, if the trace holds several kinds")

    def __post_init__(self) -> None:
        check(self)


def run_export(path: Path, config: ExportConfig) -> int:
    """Write the tasks of a trace that ran on both sites as a dataset."""
    rows = read(path, config.kind)
    write_csv(config.csv, rows)
    left_out = f", {rows.left_out} tasks without both times left out" if rows.left_out else ""
    print(f"written: {config.csv} ({len(rows)} rows{left_out})")
    return 0
