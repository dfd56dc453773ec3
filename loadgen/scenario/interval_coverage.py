"""How well the intervals of a trace's predictions held: each execution's time against those of its site.

A run that was given up after the upper end of its interval missed it; one given up before tells nothing.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np

from offboard.loadgen.table.rows import Column

Late = Mapping[tuple[str, str], float]


@dataclass(frozen=True, slots=True)
class Interval:
    """The interval of one execution on a site: its width, and whether the time was in it.

    `error_s` is the time less the predicted one; infinite where the run was given up.
    """

    site: str
    predicted_s: float
    width_s: float
    error_s: float
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
        if seconds is None and one["censored"] and one["seconds"] > high_s:
            seconds = math.inf
        if seconds is not None:
            predicted_s, held = outlook["predicted_s"], low_s <= seconds <= high_s
            found.append(Interval(one["site"], predicted_s, high_s - low_s, seconds - predicted_s, held))
    return tuple(found)


def interval_columns(tasks: Sequence[Sequence[Interval]]) -> dict[str, Column]:
    """A row a task, with a place for each of its intervals; NaN where there is none. Sites are numbered."""
    shape = len(tasks), max(map(len, tasks), default=0)
    numbers = {site: n for n, site in enumerate(sorted({one.site for task in tasks for one in task}))}
    columns = {
        name: np.full(shape, np.nan) for name in ("site", "held", "relative_width", "width_s", "error_s")
    }
    for n, task in enumerate(tasks):
        for place, one in enumerate(task):
            columns["site"][n, place] = numbers[one.site]
            columns["held"][n, place] = one.held
            columns["relative_width"][n, place] = one.width_s / one.predicted_s
            columns["width_s"][n, place] = one.width_s
            columns["error_s"][n, place] = one.error_s
    return columns


def interval_figures(columns: Mapping[str, Column], picks: Any) -> dict[str, Column]:
    """Of each resample of tasks: share of times within their interval, median of the widths over the
    predicted times, and over the width of the constant interval of the same site that holds as many."""
    held, widths = (columns[name][picks].reshape(len(picks), -1) for name in ("held", "relative_width"))
    count = (~np.isnan(held)).sum(axis=-1)
    inside = np.nansum(held, axis=-1)
    share = np.divide(inside, count, where=count > 0, out=np.full(len(picks), np.nan))
    over_constant = _over_constant(columns, picks)
    return {
        "coverage_percent": 100 * share,
        "relative_width": _median(widths, count),
        "width_over_constant": _median(over_constant, (~np.isnan(over_constant)).sum(axis=-1)),
    }


def _over_constant(columns: Mapping[str, Column], picks: Any) -> Column:
    """Each width over that of the shortest interval around all predictions of its site that holds as many."""
    site, width_s, error_s, held = (
        columns[name][picks].reshape(len(picks), -1) for name in ("site", "width_s", "error_s", "held")
    )
    found = np.full(site.shape, np.nan)
    for number in np.unique(columns["site"][~np.isnan(columns["site"])]):
        mine = site == number
        ordered = np.sort(np.where(mine, error_s, np.nan), axis=-1)  # NaN comes last
        inside = np.where(mine, held, 0.0).sum(axis=-1).astype(int)
        constant_s = np.array([_shortest(row, n) for row, n in zip(ordered, inside, strict=True)])
        np.divide(width_s, constant_s[:, None], where=mine & (constant_s > 0)[:, None], out=found)
    return found


def _shortest(ordered: Column, held: int) -> float:
    """The width of the shortest interval that holds so many; NaN for none."""
    finite = ordered[np.isfinite(ordered)]
    if not 0 < held <= len(finite):
        return np.nan
    return float((finite[held - 1 :] - finite[: len(finite) - held + 1]).min())


def _median(values: Column, count: Any) -> Column:
    """Along the last axis, over the `count` that are there; NaN where none is."""
    if not values.shape[-1]:
        return np.full(len(values), np.nan)
    ordered, rows = np.sort(values, axis=-1), np.arange(len(values))  # NaN comes last
    found: Column = (ordered[rows, (count - 1) // 2] + ordered[rows, count // 2]) / 2
    return found
