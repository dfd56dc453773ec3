"""Reads the files of JSON lines that a robot writes, and knows their names.

`robot_client.records` writes them, and never reads one; docs/formats.md explains the fields.
"""

import json
import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from offboard.common.errors import DataError
from offboard.robot_client.records.lines import VERSION

TRACE_FIELDS = (
    "v",
    "i",
    "id",
    "kind",
    "started_at",
    "size",
    "features",
    "sites",
    "decision",
    "executions",
    "used",
    "waited_s",
)

SUMMARY = "summary.json"  # of a run, next to the traces of its robots

Late = Mapping[tuple[str, str], Mapping[str, Any]]

log = logging.getLogger(__name__)


def read_trace(path: Path) -> Iterator[dict[str, Any]]:
    """The fields of each line of a trace."""
    return read_fields(path, TRACE_FIELDS)


def late_executions(records: Iterable[Mapping[str, Any]]) -> Late:
    """The executions that ended after their task's record was written, by task id and site."""
    return {(one["id"], one["site"]): one for record in records for one in record.get("late", ())}


def read_fields(path: Path, names: Sequence[str]) -> Iterator[dict[str, Any]]:
    """The fields of each line, which must include `names`.

    A torn last line is skipped with a warning. Any other bad line raises DataError.
    """
    try:
        file = path.open("rb")
    except OSError as error:
        raise DataError(f"{path}: {error.strerror}") from error
    with file:
        for number, line in enumerate(file, 1):
            if not line.endswith(b"\n"):
                log.warning("%s:%d: torn last line skipped; remedy: none, a crash had torn it", path, number)
                return
            yield _parse(f"{path}:{number}", line, names)


def alone_path(path: Path) -> Path:
    """The trace of the plans that `loadgen drive --alone` measures, next to the trace of the run."""
    return path.with_name(f"{path.stem}.alone.jsonl")


def reference_path(path: Path) -> Path:
    """The lines of `loadgen drive --reference`, next to the trace of the run."""
    return path.with_name(f"{path.stem}.reference.jsonl")


def drive_path(path: Path) -> Path:
    """The drive record of a run on a map, next to the trace of the run."""
    return path.with_name(f"{path.stem}.drive.jsonl")


def _parse(where: str, line: bytes, names: Sequence[str]) -> dict[str, Any]:
    try:
        fields = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise DataError(f"{where}: not a JSON line: {error}") from None
    if not isinstance(fields, dict):
        raise DataError(f"{where}: {type(fields).__name__} where an object was expected")
    if fields.get("v") != VERSION:
        raise DataError(f"{where}: v = {fields.get('v')!r}; this version reads {VERSION}")
    missing = [name for name in names if name not in fields]
    if missing:
        raise DataError(f"{where}: no field {missing[0]!r}")
    return fields
