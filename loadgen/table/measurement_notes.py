"""Notes on how the rows of a file were measured; every table of that file prints them.

The notes of a dataset NAME.csv are in NAME.json. The notes of a trace are its disturbance, if it was
measured: how much slower a task is on one site while it also runs on the other one. It is computed from the
trace of `loadgen drive --alone`, in which each plan ran onboard alone, in the cloud alone, and on both sites
at once.
"""

import json
import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from offboard.common.errors import DataError
from offboard.common.wording import duration
from offboard.loadgen.robot_files import alone_path, read_trace
from offboard.loadgen.table.confidence_intervals import Blocks
from offboard.loadgen.table.measured_rows import SEVERAL_NUMBERS, SHOWN_MAX, VALUE_MAX, Rows, is_csv, read
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

ALONE = "trace.alone.jsonl"  # in the folder of a run
SEED = 1
LEAST_S = 1e-9  # a ratio needs a time of at least this
OTHER = {ONBOARD: CLOUD, CLOUD: ONBOARD}
WAYS = (frozenset({ONBOARD}), frozenset({CLOUD}), frozenset({ONBOARD, CLOUD}))


def read_noted(path: Path, kind: str | None = None, *, least: int = 1) -> Rows:
    """`measured_rows.read`, with the notes."""
    rows = read(path, kind, least=least)
    several = [] if rows.more is None else [SEVERAL_NUMBERS.format(1 + rows.more.shape[1])]
    return replace(rows, notes=(*notes(path), *several))


def notes(path: Path) -> tuple[str, ...]:
    """The notes of a trace or a dataset; empty if there are none."""
    if is_csv(path):
        return _written(path.with_suffix(".json"))
    found = disturbance(path)
    return tuple(found.lines()) if found else ()


def disturbance(trace: Path) -> "Disturbance | None":
    """The disturbance that was measured after the run of this trace; None if it was not measured."""
    alone = alone_path(trace)
    return measure(alone) if alone.is_file() else None


def _written(path: Path) -> tuple[str, ...]:
    if not path.is_file():
        return ()
    try:
        found = json.loads(path.read_text(encoding="utf-8"))["notes"]
    except (OSError, ValueError, RecursionError, KeyError, TypeError) as error:
        remedy = "the file must come from `loadgen dataset`"
        raise DataError(f"{path}: no notes found: {error}; {remedy}") from error
    if not (isinstance(found, list) and all(isinstance(note, str) for note in found)):
        raise DataError(f"{path}: notes is not a list of lines of text")
    return tuple(found)


@dataclass(frozen=True, slots=True)
class Change:
    """One kind of time, measured on one site alone and with the other site running too, over `pairs` plans.

    `alone_s`: the median time on this site alone, in seconds. `beside_s`: that with both sites running.
    `ratio`: the median over the plans of the second time divided by the first. `ratio_low`, `ratio_high`: its
    95 % interval; None: too few pairs.
    """

    pairs: int
    alone_s: float
    beside_s: float
    ratio: float
    ratio_low: float | None
    ratio_high: float | None

    def __str__(self) -> str:
        alone, both = duration(self.alone_s), duration(self.beside_s)
        found = f"{alone} alone, {both} with both sites running, ratio {self.ratio:.3f}"
        if self.ratio_low is None:
            return found
        return f"{found} (95 % interval: {self.ratio_low:.3f} to {self.ratio_high:.3f})"


@dataclass(frozen=True, slots=True)
class SiteChange:
    """How the other site's execution changes the times of one site.

    `seconds` is the time from publishing the task to its answer, `network` the part outside the server (None
    onboard). `cpu_share` is the median of cpu_s / run_s on this site alone: about 0 for a task that only
    waits; None: not measured.
    """

    seconds: Change
    network: Change | None
    cpu_share: float | None


@dataclass(frozen=True, slots=True)
class Disturbance:
    """The changes by site, over `plans` plans.

    `skipped` counts records that do not belong to a complete plan.
    """

    plans: int
    skipped: int
    sites: Mapping[str, SiteChange]

    def lines(self) -> list[str]:
        found = [
            f"Disturbance between the sites, from {self.plans} plans that ran on each site alone and on both "
            f"at once ({self.skipped} records of incomplete plans were skipped):"
        ]
        for site, change in self.sites.items():
            found.append(f"{site}, total time: {change.seconds}")
            if change.network is not None:
                found.append(f"{site}, time outside the server: {change.network}")
            if change.cpu_share is not None:
                share = f"{change.cpu_share:.0%}"
                found.append(f"{site}, alone: the task used the CPU for {share} of its run time")
        return found

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


def measure(path: Path, *, seed: int = SEED) -> Disturbance | None:
    """The disturbance in a trace of `loadgen drive --alone`.

    None if no plan succeeded in all three ways.
    """
    plans, skipped = _plans(list(_runs(path)))
    if not plans:
        return None
    return Disturbance(len(plans), skipped, {site: _site_change(plans, site, seed) for site in OTHER})


class _Times(NamedTuple):
    seconds: float
    network_s: float | None
    cpu_share: float | None


# One record of the trace: the size, and the times by site; no times if any of its executions failed.
_Run = tuple[tuple[float, ...], Mapping[str, _Times]]
_Plan = Mapping[frozenset[str], Mapping[str, _Times]]  # the sites that it ran on -> site -> times


def _plans(runs: Sequence[_Run]) -> tuple[list[_Plan], int]:
    """All complete plans, each from three neighbouring records, and the number of left over records."""
    found: list[_Plan] = []
    at = 0
    while at < len(runs):
        three = runs[at : at + len(WAYS)]
        plan = {frozenset(times): times for _, times in three}
        if set(plan) == set(WAYS) and len({size for size, _ in three}) == 1:
            found.append(plan)
            at += len(WAYS)
        else:
            at += 1
    return found, len(runs) - len(WAYS) * len(found)


def _site_change(plans: Sequence[_Plan], site: str, seed: int) -> SiteChange:
    pairs = [(plan[frozenset({site})][site], plan[frozenset(OTHER)][site]) for plan in plans]
    seconds = [(alone.seconds, both.seconds) for alone, both in pairs]
    network = [  # onboard has no network time
        (alone.network_s, both.network_s)
        for alone, both in pairs
        if alone.network_s is not None and both.network_s is not None and alone.network_s >= LEAST_S
    ]
    shares = [alone.cpu_share for alone, _ in pairs if alone.cpu_share is not None]
    return SiteChange(
        _change(seconds, seed),
        _change(network, seed) if network else None,
        statistics.median(shares) if shares else None,
    )


def _change(pairs: Sequence[tuple[float, float]], seed: int) -> Change:
    alone_s, both_s = np.array(pairs).T
    ratios = both_s / alone_s
    # The plans were measured one by one and are independent, so the blocks have one row.
    blocks = Blocks(len(pairs), length=1, seed=seed)
    low, high = blocks.interval(lambda picks: np.median(ratios[picks], axis=1))
    return Change(
        pairs=len(pairs),
        alone_s=float(np.median(alone_s)),
        beside_s=float(np.median(both_s)),
        ratio=float(np.median(ratios)),
        ratio_low=low,
        ratio_high=high,
    )


def _runs(path: Path) -> Iterator[_Run]:
    for line, fields in enumerate(read_trace(path), 1):
        where = f"{path}:{line}"
        try:
            ran = fields["executions"]
            good = all(one["ok"] and not one["censored"] for one in ran)
            times = {one["site"]: _times(where, one) for one in ran} if good else {}
        except (TypeError, KeyError) as error:
            needed = "site, seconds, ok, censored, run_s and network_s"
            raise DataError(f"{where}: executions: {error!r}; each needs {needed}") from None
        sizes = fields["size"] if isinstance(fields["size"], list) else [fields["size"]]
        yield tuple(_number(f"{where}: size", one) for one in sizes), times


def _times(where: str, one: Mapping[str, Any]) -> _Times:
    def number(name: str, low: float = 0.0) -> float:
        return _number(f"{where}: {name} of {one['site']}", one[name], low)

    network_s = None if one["network_s"] is None else number("network_s")
    # Older traces lack cpu_s, and older servers do not send it.
    share = None if one.get("cpu_s") is None else number("cpu_s") / number("run_s", LEAST_S)
    return _Times(number("seconds", LEAST_S), network_s, share)


def _number(what: str, value: Any, low: float = 0.0) -> float:
    """The value as a number; DataError if it is not a number in the allowed range."""
    if type(value) not in (int, float) or not low <= value <= VALUE_MAX:
        raise DataError(f"{what}: {value!r:.{SHOWN_MAX}} is not a number from {low:g} to {VALUE_MAX:g}")
    return float(value)
