"""How the rows of a file were measured, a line each, to be printed with whatever is computed from them.

Of a dataset NAME.csv they are in NAME.json; of a trace they are the disturbance, where that was measured.
"""

import json
from dataclasses import replace
from pathlib import Path

from offboard.common.errors import DataError
from offboard.loadgen.table.disturbance import Disturbance, measure
from offboard.loadgen.table.rows import Rows, is_csv, read
from offboard.robot_client.records.trace import alone_path


def read_noted(path: Path, kind: str | None = None, *, least: int = 1) -> Rows:
    """`rows.read`, with the notes."""
    return replace(read(path, kind, least=least), notes=notes(path))


def notes(path: Path) -> tuple[str, ...]:
    """Of a trace or dataset; none where nobody wrote any."""
    if is_csv(path):
        return _written(path.with_suffix(".json"))
    found = disturbance(path)
    return tuple(found.lines()) if found else ()


def disturbance(trace: Path) -> Disturbance | None:
    """What was measured after the run of this trace."""
    alone = alone_path(trace)
    return measure(alone) if alone.is_file() else None


def _written(path: Path) -> tuple[str, ...]:
    if not path.is_file():
        return ()
    try:
        found = json.loads(path.read_text(encoding="utf-8"))["notes"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"{path}: holds no notes: {error}; `loadgen dataset` writes it") from error
    if not (isinstance(found, list) and all(isinstance(note, str) for note in found)):
        raise DataError(f"{path}: notes: not a list of lines")
    return tuple(found)
