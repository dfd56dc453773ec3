"""Notes on how the rows of a file were measured; every table of that file prints them.

The notes of a dataset NAME.csv are in NAME.json. The notes of a trace are its disturbance, if it was
measured.
"""

import json
from dataclasses import replace
from pathlib import Path

from offboard.common.errors import DataError
from offboard.loadgen.robot_files import alone_path
from offboard.loadgen.table.measured_rows import Rows, is_csv, read
from offboard.loadgen.table.site_disturbance import Disturbance, measure


def read_noted(path: Path, kind: str | None = None, *, least: int = 1) -> Rows:
    """`measured_rows.read`, with the notes."""
    return replace(read(path, kind, least=least), notes=notes(path))


def notes(path: Path) -> tuple[str, ...]:
    """The notes of a trace or a dataset; empty if there are none."""
    if is_csv(path):
        return _written(path.with_suffix(".json"))
    found = disturbance(path)
    return tuple(found.lines()) if found else ()


def disturbance(trace: Path) -> Disturbance | None:
    """The disturbance that was measured after the run of this trace; None if it was not measured."""
    alone = alone_path(trace)
    return measure(alone) if alone.is_file() else None


def _written(path: Path) -> tuple[str, ...]:
    if not path.is_file():
        return ()
    try:
        found = json.loads(path.read_text(encoding="utf-8"))["notes"]
    except (OSError, ValueError, RecursionError, KeyError, TypeError) as error:
        raise DataError(
            f"{path}: no notes found: {error}; the file must come from `loadgen dataset`"
        ) from error
    if not (isinstance(found, list) and all(isinstance(note, str) for note in found)):
        raise DataError(f"{path}: notes is not a list of lines of text")
    return tuple(found)
