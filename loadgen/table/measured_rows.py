"""Measured rows: reads tasks with both times known (size, onboard_s, cloud_s) from a trace or a CSV dataset.

`table_two` and `replay` compute figures from them. What else a dataset holds is read by
`replay/dataset_file`.
"""

import csv
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from offboard.common.errors import ConfigError, DataError
from offboard.common.security.plain_files import replace_file
from offboard.common.tasks import SIZE_NUMBERS_MAX, Size
from offboard.loadgen.robot_files import read_trace
from offboard.robot_client.policies import PINNED
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

HEADER = ("size", "onboard_s", "cloud_s")
MORE_SIZES = tuple(f"size_{number}" for number in range(2, SIZE_NUMBERS_MAX + 1))  # of several numbers
ROWS_MAX = 1_000_000
VALUE_MAX = 1e15  # for seconds and sizes; keeps every sum and square finite
ALLOWED = f"a finite number from 0 to {VALUE_MAX:g}"

FIRST_NUMBER = "{} (first number)"  # the name of what predicts from the first number of each size only
SEVERAL_NUMBERS = "Each size has {} numbers; r and what says so use the first one, all other lines use all."
SHOWN_MAX = 60  # characters of a wrong value that an error message shows

Column = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Rows:
    """Three columns of equal length, in the order in which the tasks ran.

    `size`: of several numbers, the first one; `more` (rows x numbers): the others. `left_out` counts the
    tasks without both times. Each line of `notes` says something about how the rows were measured.
    """

    size: Column
    onboard_s: Column
    cloud_s: Column
    left_out: int = 0
    notes: tuple[str, ...] = ()
    more: Column | None = None

    def __len__(self) -> int:
        return len(self.size)

    def counted(self) -> str:
        """How many rows and left out tasks there are, in words."""
        left_out = f" ({self.left_out} tasks without both times left out)" if self.left_out else ""
        return f"{len(self)} rows{left_out}"

    def about(self, path: Path) -> dict[str, Any]:
        """What a table of these rows says in each of its lines."""
        return {"source": str(path), "rows": len(self), "left_out": self.left_out}

    def since(self, start: int) -> "Rows":
        more = None if self.more is None else self.more[start:]
        return Rows(self.size[start:], self.onboard_s[start:], self.cloud_s[start:], more=more)

    def sizes(self) -> Sequence[Size]:
        """The size of each row; a tuple if it has several numbers."""
        if self.more is None:
            found: list[float] = self.size.tolist()
            return found
        return [tuple(one) for one in np.column_stack((self.size, self.more)).tolist()]

    def by_first_number(self) -> "Rows | None":
        """The same rows with only the first number of each size; None if there is only one."""
        return None if self.more is None else replace(self, more=None)


@dataclass(frozen=True, slots=True)
class Lived:
    """The tasks that the robot's policy placed: how long each caller waited, and which went to the cloud."""

    waited_s: Column
    to_cloud: npt.NDArray[np.bool_]


class NoOneTable(DataError):
    """The tasks of a trace do not fit one table, because there are several kinds."""


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
                lived.append((number(where, "waited_s", fields["waited_s"]), decision["site"] == CLOUD))
        except (TypeError, KeyError) as error:
            raise DataError(f"{where}: decision: {error!r}; site, both and policy are needed") from None
    _check_one_kind(path, first_lines)
    return Lived(np.array([s for s, _ in lived]), np.array([cloud for _, cloud in lived], dtype=bool))


def read_cells(path: Path, further: Collection[str] = ()) -> Iterator[tuple[str, dict[str, str]]]:
    """The cells of each row of a CSV dataset by column, after its place: FILE:LINE.

    Those of the columns of HEADER, which must be there, and of those of `further` that are.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            yield from _rows_of_cells(path, file, further)
    except OSError as error:
        raise DataError(f"{path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: not UTF-8 text: {error.reason} at byte {error.start}") from error


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file completely; if that fails, leave the old one as it was."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, content.encode() if isinstance(content, str) else content)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}") from error


def is_csv(path: Path) -> bool:
    """Whether a file is a CSV dataset; any other file is a trace."""
    return path.suffix.lower() == ".csv"


def number(where: str, name: str, value: Any) -> float:
    """The value of a cell or field as a number; `where` is its file and line."""
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not 0 <= number <= VALUE_MAX:
        raise DataError(f"{where}: {name}: {short(value)} is not {ALLOWED}")
    return number


def short(value: Any) -> str:
    """How an error message shows a wrong value."""
    text = repr(value)
    return text if len(text) <= SHOWN_MAX else f"{text[:SHOWN_MAX]}.."


def _read_csv(path: Path) -> Rows:
    found = []
    for where, cells in read_cells(path, MORE_SIZES):
        names = (*HEADER, *more_sizes(where, cells))
        found.append([number(where, name, cells[name]) for name in names])
    return _rows(found)


def more_sizes(where: str, cells: Collection[str]) -> tuple[str, ...]:
    """The columns of further numbers of a size among these; DataError if one before them is missing."""
    names = tuple(filter(cells.__contains__, MORE_SIZES))
    if names != MORE_SIZES[: len(names)]:
        missing = next(name for name in MORE_SIZES if name not in names)
        raise DataError(f"{where}: there is a column {names[-1]!r}, but no column {missing!r}")
    return names


def _rows_of_cells(
    path: Path, file: Iterator[str], further: Collection[str]
) -> Iterator[tuple[str, dict[str, str]]]:
    reader, count = csv.reader(file), 0
    try:
        header = [name.strip() for name in next(reader, [])]
        places = _places(path, header, further)
        for cells in filter(None, reader):
            _check_room(path, count)
            count += 1
            # A decimal comma ends here too: 0,5 is two cells.
            if len(cells) != len(header):
                of = f"the header has {len(header)}: {','.join(header)}"
                raise DataError(f"{path}:{reader.line_num}: {len(cells)} cells, but {of}")
            yield f"{path}:{reader.line_num}", {name: cells[place] for name, place in places.items()}
    except csv.Error as error:
        raise DataError(f"{path}:{reader.line_num}: {error}") from error
    if not count:
        raise DataError(f"{path}: there are no rows below the header")


def _places(path: Path, header: Sequence[str], further: Collection[str]) -> Mapping[str, int]:
    if not header:
        raise DataError(f"{path}:1: the header is missing; the first line must be {','.join(HEADER)}")
    for name in (*HEADER, *further):
        if header.count(name) > 1 or (name in HEADER and name not in header):
            found = f"has no column {name!r}" if name not in header else f"has the column {name!r} twice"
            allowed = f"it must be {','.join(HEADER)}, then other columns, each once"
            raise DataError(f"{path}:1: header {short(','.join(header))} {found}; {allowed}")
    return {name: header.index(name) for name in (*HEADER, *further) if name in header}


def _read_trace(path: Path, kind: str | None, least: int) -> Rows:
    found: list[list[float]] = []
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
        _check_room(path, len(found))
        found.append(row)
        if len(row) != len(found[0]) and len(first_lines) == 1:
            counts = f"{len(row) - 2} numbers, but that of the first row has {len(found[0]) - 2}"
            raise DataError(f"{path}:{line}: size: {short(fields['size'])} has {counts}")
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
        raise NoOneTable(f"{path}: the trace holds tasks of several kinds: {kinds}; choose one with --kind")


def _trace_row(where: str, fields: dict[str, Any]) -> list[float] | None:
    """As in the header of a dataset, then the further numbers; None if a site did not finish the task."""
    seconds: dict[str, float] = {}
    try:
        for one in fields["executions"]:
            if one["ok"] and not one["censored"]:
                seconds.setdefault(one["site"], number(where, f"seconds of {one['site']}", one["seconds"]))
    except (TypeError, KeyError) as error:
        raise DataError(
            f"{where}: executions: {error!r}; each needs site, seconds, ok and censored"
        ) from None
    if ONBOARD not in seconds or CLOUD not in seconds:
        return None
    size, *more = fields["size"] if isinstance(fields["size"], list) and fields["size"] else [fields["size"]]
    sizes = [number(where, "size", one) for one in (size, *more)]
    return [sizes[0], seconds[ONBOARD], seconds[CLOUD], *sizes[1:]]


def _check_room(path: Path, count: int) -> None:
    if count == ROWS_MAX:
        raise DataError(f"{path}: more than {ROWS_MAX} rows, which is the most allowed")


def _rows(found: Sequence[Sequence[float]], left_out: int = 0) -> Rows:
    width = len(found[0]) if found else len(HEADER)
    size, onboard_s, cloud_s, *more = np.array(found, dtype=np.float64).reshape(-1, width).T.copy()
    return Rows(size, onboard_s, cloud_s, left_out, more=np.column_stack(more) if more else None)
