"""Prediction intervals of a trace: how often an execution's time lay within the interval of its site.

An execution that was given up counts as a miss if it had already run past the upper end of its interval.
If it was given up earlier, its true time is unknown and it does not count.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from offboard.loadgen.robot_files import Late
from offboard.loadgen.table.measured_rows import Column


@dataclass(frozen=True, slots=True)
class Interval:
    """The prediction interval of one execution, and whether the measured time lay within it (`held`).

    `error_s` is the measured time minus the prediction; infinite if the execution was given up.
    """

    site: str
    predicted_s: float
    width_s: float
    error_s: float
    held: bool


def intervals_of(record: Mapping[str, Any], late: Late) -> tuple[Interval, ...]:
    """The intervals of one record's executions, without those that have no interval or no usable time."""
    found = []
    for one in record.get("executions", ()):
        outlook = record["sites"].get(one["site"], {})
        low_s, high_s = outlook.get("low_s"), outlook.get("high_s")
        if low_s is None or high_s is None or not outlook["predicted_s"]:
            continue
        ended = one if one["ok"] else late.get((record["id"], one["site"]), one)
        seconds = ended["seconds"] if ended["ok"] else None
        if seconds is None and one["censored"] and one["seconds"] > high_s:
            seconds = math.inf
        if seconds is not None:
            predicted_s = outlook["predicted_s"]
            found.append(
                Interval(
                    site=one["site"],
                    predicted_s=predicted_s,
                    width_s=high_s - low_s,
                    error_s=seconds - predicted_s,
                    held=low_s <= seconds <= high_s,
                )
            )
    return tuple(found)


def interval_columns(tasks: Sequence[Sequence[Interval]]) -> dict[str, Column]:
    """One row for each task, one column for each of its intervals, filled up with NaN. Sites are numbered."""
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
    """Three figures for each resample of tasks (one row of `picks`).

    - `coverage_percent`: share of the times that lay within their interval
    - `relative_width`: median of width / predicted time
    - `width_over_constant`: median of width / width of the best constant interval of the same site, which is
      the shortest interval around all its predictions that holds the same number of times
    """
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
    """Each width divided by the width of the best constant interval of its site."""
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
    """The width of the shortest interval that holds `held` values; NaN if there is none."""
    finite = ordered[np.isfinite(ordered)]
    if not 0 < held <= len(finite):
        return np.nan
    return float((finite[held - 1 :] - finite[: len(finite) - held + 1]).min())


def _median(values: Column, count: Any) -> Column:
    """The median of the last axis over the first `count` sorted values; NaN if `count` is 0."""
    if not values.shape[-1]:
        return np.full(len(values), np.nan)
    ordered, rows = np.sort(values, axis=-1), np.arange(len(values))  # NaN comes last
    found: Column = (ordered[rows, (count - 1) // 2] + ordered[rows, count // 2]) / 2
    return found
