"""Measured rows: reads tasks with both times known (size, onboard_s, cloud_s) from a trace or a CSV dataset.

`predictor_evaluation` and `replay` compute figures from them.
"""

import csv
import io
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from offboard.common.errors import ConfigError, DataError
from offboard.common.security.plain_files import replace_file
from offboard.loadgen.robot_files import read_trace
from offboard.robot_client.policies import PINNED
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

HEADER = ("size", "onboard_s", "cloud_s")
ROWS_MAX = 1_000_000
VALUE_MAX = 1e15  # for seconds and sizes; keeps every sum and square finite
ALLOWED = f"a finite number from 0 to {VALUE_MAX:g}"

SHOWN_MAX = 60  # characters of a wrong value that an error message shows

Row = tuple[float, float, float]  # size, onboard_s, cloud_s
Column = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Rows:
    """Three columns of equal length, in the order in which the tasks ran.

    `left_out` counts the tasks without both times. Each line of `notes` says something about how the rows
    were measured.
    """

    size: Column
    onboard_s: Column
    cloud_s: Column
    left_out: int = 0
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.size)

    def since(self, start: int) -> "Rows":
        """The rows from index `start` on."""
        return Rows(self.size[start:], self.onboard_s[start:], self.cloud_s[start:])


@dataclass(frozen=True, slots=True)
class Lived:
    """The tasks that the robot's policy placed: how long each caller waited, and which went to the cloud."""

    waited_s: Column
    to_cloud: npt.NDArray[np.bool_]


def read(path: Path, kind: str | None = None, *, least: int = 1) -> Rows:
    """Read a dataset (`.csv`) or a trace (any other name); `kind` selects one kind of task of a trace.

    DataError if a trace has fewer than `least` rows.
    """
    if not is_csv(path):
        return _read_trace(path, kind, least)
    if kind is not None:
        raise ConfigError(f"--kind: {kind!r} works only with traces; {path} is a CSV dataset without kinds")
    return _read_csv(path)


def read_lived(path: Path, kind: str | None = None) -> Lived:
    """The tasks of a trace that a policy placed; a CSV dataset has none."""
    lived: list[tuple[float, bool]] = []
    first_lines: dict[str, int] = {}  # of each kind
    for line, fields in enumerate(() if is_csv(path) else read_trace(path), 1):
        decision, where = fields["decision"], f"{path}:{line}"
        if kind is not None and fields["kind"] != kind:
            continue
        try:
            if not decision["both"] and decision["policy"] != PINNED:
                first_lines.setdefault(str(fields["kind"]), line)
                lived.append((_number(where, "waited_s", fields["waited_s"]), decision["site"] == CLOUD))
        except (TypeError, KeyError) as error:
            raise DataError(f"{where}: decision: {error!r}; site, both and policy are needed") from None
    _check_one_kind(path, first_lines)
    return Lived(np.array([s for s, _ in lived]), np.array([cloud for _, cloud in lived], dtype=bool))


def write_csv(path: Path, rows: Rows) -> None:
    """Write a dataset that `read` reads back to the last digit. If writing fails, an existing file stays."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(HEADER)
    writer.writerows(zip(rows.size.tolist(), rows.onboard_s.tolist(), rows.cloud_s.tolist(), strict=True))
    write_whole(path, text.getvalue())


def write_whole(path: Path, text: str) -> None:
    """Write a file completely; if that fails, leave the old one as it was."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, text.encode())
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}") from error


def is_csv(path: Path) -> bool:
    """Whether a file is a CSV dataset; any other file is a trace."""
    return path.suffix.lower() == ".csv"


def _read_csv(path: Path) -> Rows:
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            found = _csv_rows(path, file)
    except OSError as error:
        raise DataError(f"{path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: not UTF-8 text: {error.reason} at byte {error.start}") from error
    if not found:
        raise DataError(f"{path}: there are no rows below the header")
    return _rows(found)


def _csv_rows(path: Path, file: Iterator[str]) -> list[Row]:
    reader = csv.reader(file)
    found: list[Row] = []
    try:
        header = [name.strip() for name in next(reader, [])]
        if not header:
            raise DataError(f"{path}:1: the header is missing; the first line must be {','.join(HEADER)}")
        places = [_place(path, header, name) for name in HEADER]
        for cells in reader:
            if cells:
                _add(path, found, _csv_row(f"{path}:{reader.line_num}", header, places, cells))
    except csv.Error as error:
        raise DataError(f"{path}:{reader.line_num}: {error}") from error
    return found


def _place(path: Path, header: Sequence[str], name: str) -> int:
    if header.count(name) != 1:
        found = f"has no column {name!r}" if name not in header else f"has the column {name!r} twice"
        raise DataError(f"{path}:1: header {','.join(header)!r} {found}; it must be {','.join(HEADER)}")
    return header.index(name)


def _csv_row(where: str, header: Sequence[str], places: Sequence[int], cells: Sequence[str]) -> Row:
    # A decimal comma ends here too: 0,5 is two cells.
    if len(cells) != len(header):
        raise DataError(f"{where}: {len(cells)} cells, but the header has {len(header)}: {','.join(header)}")
    size, onboard_s, cloud_s = (_number(where, header[place], cells[place]) for place in places)
    return size, onboard_s, cloud_s


def _read_trace(path: Path, kind: str | None, least: int) -> Rows:
    found: list[Row] = []
    first_lines: dict[str, int] = {}  # of each kind
    left_out = 0
    for line, fields in enumerate(read_trace(path), 1):
        if kind is not None and fields["kind"] != kind:
            continue
        row = _trace_row(f"{path}:{line}", fields)
        if row is None:
            left_out += 1
            continue
        first_lines.setdefault(str(fields["kind"]), line)
        _add(path, found, row)
    if len(found) < least:
        raise DataError(
            f"{path}: no {kind or 'task'} was answered by both sites; measure some with "
            "`loadgen run SCENARIO --measure both` or `loadgen drive --measure K`"
        )
    _check_one_kind(path, first_lines)
    return _rows(found, left_out)


def _check_one_kind(path: Path, first_lines: dict[str, int]) -> None:
    if len(first_lines) > 1:
        kinds = ", ".join(f"{name} (line {line})" for name, line in first_lines.items())
        raise DataError(f"{path}: the trace holds tasks of several kinds: {kinds}; choose one with --kind")


def _trace_row(where: str, fields: dict[str, Any]) -> Row | None:
    """The size and both times; None if a site did not finish the task."""
    seconds: dict[str, float] = {}
    try:
        for one in fields["executions"]:
            if one["ok"] and not one["censored"]:
                seconds.setdefault(one["site"], _number(where, f"seconds of {one['site']}", one["seconds"]))
    except (TypeError, KeyError) as error:
        raise DataError(
            f"{where}: executions: {error!r}; each needs site, seconds, ok and censored"
        ) from None
    if ONBOARD not in seconds or CLOUD not in seconds:
        return None
    size = fields["size"]
    if isinstance(size, list):
        raise DataError(f"{where}: size: {_short(size)} has several numbers; one is needed here")
    return _number(where, "size", size), seconds[ONBOARD], seconds[CLOUD]


def _number(where: str, name: str, value: Any) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not 0 <= number <= VALUE_MAX:
        raise DataError(f"{where}: {name}: {_short(value)} is not {ALLOWED}")
    return number


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= SHOWN_MAX else f"{text[:SHOWN_MAX]}.."


def _add(path: Path, found: list[Row], row: Row) -> None:
    if len(found) == ROWS_MAX:
        raise DataError(f"{path}: more than {ROWS_MAX} rows, which is the most allowed")
    found.append(row)


def _rows(found: list[Row], left_out: int = 0) -> Rows:
    size, onboard_s, cloud_s = np.array(found, dtype=np.float64).reshape(-1, 3).T.copy()
    return Rows(size, onboard_s, cloud_s, left_out)
