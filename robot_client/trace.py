"""The trace: one JSON line a task, what was predicted, decided and seen."""

import contextlib
import errno
import json
import logging
import os
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from common.errors import ConfigError, DataError
from robot_client.policies import Decision, Outlook
from robot_client.runner import Execution

VERSION = 1
LINE_START = b'{"v":'

_FIELDS = (
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
_EXECUTION_FIELDS = (
    "site",
    "seconds",
    "ok",
    "error",
    "censored",
    "queue_s",
    "run_s",
    "network_s",
    "cpu_s",
    "bytes_out",
    "bytes_in",
)

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Record:
    """Everything about one task, written once it is answered; `used` is the site whose answer was used."""

    i: int
    id: str
    kind: str
    size: float
    sites: Mapping[str, Outlook]
    decision: Decision
    executions: tuple[Execution, ...]
    used: str | None
    waited_s: float
    features: Mapping[str, float] = field(default_factory=dict)
    started_at: datetime = field(default_factory=lambda: datetime.now(UTC))


class Trace:
    """Appends records to a file, unbuffered; a line that cannot be written is logged and tasks go on."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            if path.is_file():
                self._cut_torn_line()
            self._file = path.open("ab", buffering=0)
        except OSError as error:
            raise ConfigError(f"trace {path}: {error.strerror}") from error
        self.lost = 0  # records that could not be written

    def write(self, record: Record) -> None:
        line = json.dumps(as_dict(record), separators=(",", ":")).encode() + b"\n"
        end = os.fstat(self._file.fileno()).st_size
        try:
            if self._file.write(line) < len(line):  # a disk that fills up takes the part that fits
                raise OSError(errno.ENOSPC, "no space left for the whole line")
        except OSError as error:
            self.lost += 1
            log.error(
                "trace %s: task %d lost (%d so far): %s", self.path, record.i, self.lost, error.strerror
            )
            with contextlib.suppress(OSError):
                os.truncate(self._file.fileno(), end)

    def close(self) -> None:
        if not self._file.closed:
            self._file.close()

    def _cut_torn_line(self) -> None:
        """A crash may have left half a line, which would spoil the next one. No other file is touched."""
        with self.path.open("rb") as file:
            start = file.read(len(LINE_START))
        if not LINE_START.startswith(start):
            raise ConfigError(f"trace {self.path}: the file is there and is no trace")
        kept = _end_of_last_line(self.path)
        if kept < self.path.stat().st_size:
            log.warning("trace %s: cut off a torn last line", self.path)
            os.truncate(self.path, kept)


def alone_path(path: Path) -> Path:
    """The trace of the plans that `robot-client --alone` measures, beside the trace of the run."""
    return path.with_name(f"{path.stem}.alone.jsonl")


def as_dict(record: Record) -> dict[str, Any]:
    """The record as its JSON line holds it (DESIGN, Trace)."""
    return {
        "v": VERSION,
        "i": record.i,
        "id": record.id,
        "kind": record.kind,
        "started_at": record.started_at.isoformat(timespec="milliseconds"),
        "size": record.size,
        "features": dict(record.features),
        "sites": {site: _outlook(outlook) for site, outlook in record.sites.items()},
        "decision": asdict(record.decision),
        "executions": [{name: getattr(one, name) for name in _EXECUTION_FIELDS} for one in record.executions],
        "used": record.used,
        "waited_s": record.waited_s,
    }


def read(path: Path) -> Iterator[dict[str, Any]]:
    """Each line's fields. A torn last line is skipped with a warning; any other bad line is a DataError."""
    try:
        file = path.open("rb")
    except OSError as error:
        raise DataError(f"{path}: {error.strerror}") from error
    with file:
        for number, line in enumerate(file, 1):
            if not line.endswith(b"\n"):
                log.warning("%s:%d: torn last line skipped", path, number)
                return
            yield _parse(path, number, line)


def _parse(path: Path, number: int, line: bytes) -> dict[str, Any]:
    try:
        fields = json.loads(line)
    except ValueError as error:
        raise DataError(f"{path}:{number}: not a JSON line: {error}") from None
    if not isinstance(fields, dict):
        raise DataError(f"{path}:{number}: {type(fields).__name__} where an object was expected")
    if fields.get("v") != VERSION:
        raise DataError(f"{path}:{number}: v = {fields.get('v')!r}; this version reads {VERSION}")
    missing = [name for name in _FIELDS if name not in fields]
    if missing:
        raise DataError(f"{path}:{number}: no field {missing[0]!r}")
    return fields


def _outlook(outlook: Outlook) -> dict[str, Any]:
    return {name: getattr(outlook, name) for name in ("predicted_s", "spread_s", "age", "failures")}


def _end_of_last_line(path: Path) -> int:
    """Bytes up to and including the last newline; looks at the tail only."""
    with path.open("rb") as file:
        end = file.seek(0, os.SEEK_END)
        while end > 0:
            start = max(0, end - 65536)
            file.seek(start)
            at = file.read(end - start).rfind(b"\n")
            if at >= 0:
                return start + at + 1
            end = start
    return 0
