"""How well the intervals of a trace's predictions held: each execution's time against those of its site.

A run that was given up after the upper end of its interval missed it; one given up before tells nothing.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np

from loadgen.rows import Column

Late = Mapping[tuple[str, str], float]


@dataclass(frozen=True, slots=True)
class Interval:
    """The interval of one execution: its width over the predicted time, and whether the time was in it."""

    relative_width: float
    held: bool


def late_seconds(records: Iterable[Mapping[str, Any]]) -> Late:
    """By task and site what executions took that ended well after their task's record was written."""
    late = chain.from_iterable(record.get("late", ()) for record in records)
    return {(one["id"], one["site"]): one["seconds"] for one in late if one["ok"]}


def intervals_of(record: Mapping[str, Any], late: Late) -> tuple[Interval, ...]:
    """Of the executions of one record, where their site had one and the time tells."""
    found = []
    for one in record.get("executions", ()):
        outlook = record["sites"].get(one["site"], {})
        low_s, high_s = outlook.get("low_s"), outlook.get("high_s")
        if low_s is None or high_s is None or not outlook["predicted_s"]:
            continue
        seconds = one["seconds"] if one["ok"] else late.get((record["id"], one["site"]))
        width = (high_s - low_s) / outlook["predicted_s"]
        if seconds is not None:
            found.append(Interval(width, low_s <= seconds <= high_s))
        elif one["censored"] and one["seconds"] > high_s:
            found.append(Interval(width, held=False))
    return tuple(found)


def interval_columns(tasks: Sequence[Sequence[Interval]]) -> dict[str, Column]:
    """A row a task, with a place for each of its intervals; NaN where there is none."""
    shape = len(tasks), max(map(len, tasks), default=0)
    columns = {name: np.full(shape, np.nan) for name in ("held", "relative_width")}
    for n, task in enumerate(tasks):
        for name, column in columns.items():
            column[n, : len(task)] = [getattr(one, name) for one in task]
    return columns


def interval_figures(columns: Mapping[str, Column], picks: Any) -> dict[str, Column]:
    """Share of times within their interval, and median of the widths, of each resample of tasks."""
    held, widths = (columns[name][picks].reshape(len(picks), -1) for name in ("held", "relative_width"))
    count = (~np.isnan(held)).sum(axis=-1)
    inside = np.nansum(held, axis=-1)
    share = np.divide(inside, count, where=count > 0, out=np.full(len(picks), np.nan))
    return {"coverage_percent": 100 * share, "relative_width": _median(widths, count)}


def _median(values: Column, count: Any) -> Column:
    """Along the last axis, over the `count` that are there; NaN where none is."""
    if not values.shape[-1]:
        return np.full(len(values), np.nan)
    ordered, rows = np.sort(values, axis=-1), np.arange(len(values))  # NaN comes last
    found: Column = (ordered[rows, (count - 1) // 2] + ordered[rows, count // 2]) / 2
    return found
