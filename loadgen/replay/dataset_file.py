"""Datasets: CSV files of tasks that ran onboard and in the cloud, with all that a replay needs to know.

`loadgen dataset` and `loadgen export` write them. docs/formats.md explains the columns.
"""

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from offboard.common.errors import ConfigError, DataError
from offboard.loadgen.replay.recorded_tasks import PARTS, RecordedTask, read_tasks
from offboard.loadgen.table.measured_rows import (
    ALLOWED,
    HEADER,
    MORE_SIZES,
    VALUE_MAX,
    is_csv,
    more_sizes,
    read_cells,
    short,
    write_whole,
)
from offboard.robot_client.sites.runner import (
    CLOUD,
    NOTHING,
    ONBOARD,
    TIMEOUT_MAX_S,
    TIMEOUT_S,
    UNMEASURED,
    Condition,
    Execution,
    Packed,
    Sending,
    checked_timeout,
)

SITES = (ONBOARD, CLOUD)
# What is measured of each site before a task. A replay has its own wait for the robot.
FEATURES = {ONBOARD: ("load", "capacity"), CLOUD: Condition._fields}
ALL = "-"  # in place of the number of an argument: all of them were packed together


@dataclass(frozen=True, slots=True)
class Cell:
    """How a cell is read. `read` raises ValueError or ConfigError unless the text is `allowed`."""

    read: Callable[[str], Any]
    allowed: str


def read_recorded(path: Path, kind: str | None) -> list[RecordedTask]:
    """The tasks of a trace or a dataset; `kind` selects one kind of a trace."""
    return read_dataset(path) if is_csv(path) else read_tasks(path, kind)


def measured_tasks(tasks: Sequence[RecordedTask]) -> list[RecordedTask]:
    """Those with both times, without the decisions of the run, so that a policy can decide them."""
    return [replace(one, decision=None, deadline_s=None) for one in tasks if one.measured]


def write_dataset(path: Path, tasks: Sequence[RecordedTask]) -> None:
    """Write a dataset that is read back to the last digit. If writing fails, an existing file stays.

    A column of which no task has a value is left out.
    """
    rows = [_values(task) for task in tasks]
    names = [name for name in COLUMNS if name in HEADER or any(row[name] is not None for row in rows)]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(names)
    writer.writerows([_text(row[name]) for name in names] for row in rows)
    write_whole(path, text.getvalue())


def read_dataset(path: Path) -> list[RecordedTask]:
    """The tasks of a dataset. A cell may be empty, and a column absent, except those of HEADER."""
    return [
        _task({name: _read(where, name, text) for name, text in cells.items()}, more_sizes(where, cells))
        for where, cells in read_cells(path, [name for name in COLUMNS if name not in HEADER])
    ]


def _values(task: RecordedTask) -> dict[str, Any]:
    """The value of each column; None: unknown."""
    size, *more = task.size if isinstance(task.size, tuple) else (task.size,)
    values: dict[str, Any] = {"size": size, "work": task.work, "timeout_s": task.timeout_s}
    values |= dict.fromkeys(MORE_SIZES) | dict(zip(MORE_SIZES, more, strict=False))
    for site in SITES:
        run, condition = task.runs[site], task.conditions.get(site, UNMEASURED)
        values[f"{site}_s"] = run.seconds
        values |= {f"{site}_{part}": getattr(run, part) for part in PARTS}
        unknown = condition is UNMEASURED
        values |= {f"{site}.{name}": None if unknown else getattr(condition, name) for name in FEATURES[site]}
    sending, run = task.sendings.get(CLOUD, NOTHING), task.runs[CLOUD]
    moved = run.bytes_out or run.bytes_in  # no message has 0 bytes
    return values | {
        "cloud_send_bytes": sending.bytes or None,
        "cloud_send_large": " ".join(f"{number}:{size}" for number, size in sending.large) or None,
        "cloud_packed": " ".join(map(_packed_text, run.packed)) or None,
        "cloud_bytes_out": run.bytes_out if moved else None,
        "cloud_bytes_in": run.bytes_in if moved else None,
    }


def _text(value: Any) -> str:
    if value is None or isinstance(value, str):
        return value or ""
    return repr(int(value) if float(value).is_integer() else float(value))


def _packed_text(packed: Packed) -> str:
    argument = ALL if packed.argument is None else packed.argument
    return f"{argument}:{packed.how}:{packed.raw_bytes}:{packed.bytes}:{packed.seconds!r}"


def _read(where: str, name: str, text: str) -> Any:
    """The value of one cell; None: it is empty."""
    if not text.strip() and name not in (*HEADER, *MORE_SIZES):
        return None
    cell = COLUMNS[name]
    try:
        return cell.read(text)
    except (ValueError, OverflowError, ConfigError):
        raise DataError(f"{where}: {name}: {short(text)} is not {cell.allowed}") from None


def _task(values: Mapping[str, Any], more: Sequence[str]) -> RecordedTask:
    send_bytes = values.get("cloud_send_bytes")
    sending = Sending(send_bytes, values.get("cloud_send_large") or ()) if send_bytes else NOTHING
    return RecordedTask(
        size=(values["size"], *(values[name] for name in more)) if more else values["size"],
        runs={site: _execution(site, values) for site in SITES},
        conditions={site: _condition(site, values) for site in SITES},
        sendings={CLOUD: sending},
        timeout_s=values.get("timeout_s") or TIMEOUT_S,
    )


def _execution(site: str, values: Mapping[str, Any]) -> Execution:
    part_s: dict[str, Any] = {part: values.get(f"{site}_{part}") for part in PARTS}
    bytes_out, bytes_in = values.get(f"{site}_bytes_out"), values.get(f"{site}_bytes_in")
    if bytes_out is None or bytes_in is None:
        bytes_out = bytes_in = 0  # unknown: their sum is learned, and half of it would be wrong
    return Execution(
        site,
        values[f"{site}_s"],
        values.get("work"),
        **part_s,
        bytes_out=bytes_out,
        bytes_in=bytes_in,
        packed=values.get(f"{site}_packed") or (),
    )


def _condition(site: str, values: Mapping[str, Any]) -> Condition:
    measured = {name: values.get(f"{site}.{name}") for name in FEATURES[site]}
    known = {name: value for name, value in measured.items() if value is not None}
    return Condition(**known) if known else UNMEASURED


def _number(text: str) -> float:
    number = float(text)
    if not 0 <= number <= VALUE_MAX:
        raise ValueError(text)
    return number


def _whole(text: str) -> int:
    number = _number(text)
    if not number.is_integer():
        raise ValueError(text)
    return int(number)


def _above_zero(text: str) -> float:
    number = _number(text)
    if not number:
        raise ValueError(text)
    return number


def _flag(text: str) -> bool:
    if text not in ("0", "1"):
        raise ValueError(text)
    return text == "1"


def _large(text: str) -> tuple[tuple[int, int], ...]:
    pairs = (one.split(":") for one in text.split())
    return tuple((_whole(number), _whole(size)) for number, size in pairs)


def _packed(text: str) -> tuple[Packed, ...]:
    found = []
    for one in text.split():
        argument, how, raw_bytes, size, seconds = one.split(":")
        number = None if argument == ALL else _whole(argument)
        found.append(Packed(number, how, _whole(raw_bytes), bytes=_whole(size), seconds=_number(seconds)))
    return tuple(found)


_NUMBER = Cell(_number, ALLOWED)
_BYTES = Cell(_whole, f"a whole number from 0 to {VALUE_MAX:g}")
_FEATURES = {
    "silent": Cell(_flag, "0 or 1"),
    "queue": _BYTES,
    "capacity": Cell(_above_zero, f"a number above 0, at most {VALUE_MAX:g}"),
}
COLUMNS: Mapping[str, Cell] = {
    **dict.fromkeys((*HEADER, *MORE_SIZES), _NUMBER),
    "work": _NUMBER,
    **{f"{site}_{part}": _NUMBER for site in SITES for part in PARTS},
    "cloud_bytes_out": _BYTES,
    "cloud_bytes_in": _BYTES,
    "cloud_packed": Cell(_packed, "a list of ARGUMENT:HOW:RAW_BYTES:BYTES:SECONDS with spaces between"),
    "cloud_send_bytes": _BYTES,
    "cloud_send_large": Cell(_large, "a list of ARGUMENT:BYTES with spaces between"),
    "timeout_s": Cell(
        lambda text: checked_timeout(float(text)), f"a number above 0, at most {TIMEOUT_MAX_S:g}"
    ),
    **{f"{site}.{name}": _FEATURES.get(name, _NUMBER) for site in SITES for name in FEATURES[site]},
}
