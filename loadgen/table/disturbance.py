"""What it does to a task's time when its other execution is in flight at the same moment.

Read from the trace of `robot-client --alone`: there each plan ran onboard alone, in the cloud alone, and on
both at once.
"""

import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from offboard.common.errors import DataError
from offboard.loadgen.table.bootstrap import Blocks
from offboard.loadgen.table.rows import SHOWN_MAX, VALUE_MAX
from offboard.robot_client.records import trace
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

ALONE = "trace.alone.jsonl"  # beside `play.TRACE`
SEED = 1
LEAST_S = 1e-9  # a shorter time is nothing to take a ratio to
OTHER = {ONBOARD: CLOUD, CLOUD: ONBOARD}
WAYS = (frozenset({ONBOARD}), frozenset({CLOUD}), frozenset({ONBOARD, CLOUD}))


@dataclass(frozen=True, slots=True)
class Change:
    """One time of `pairs` plans, alone and beside the other execution.

    `alone_s` and `beside_s` are medians in seconds; `ratio` is the median over the plans of beside / alone,
    `ratio_low` to `ratio_high` its 95 % interval, which a few pairs do not have.
    """

    pairs: int
    alone_s: float
    beside_s: float
    ratio: float
    ratio_low: float | None
    ratio_high: float | None

    def __str__(self) -> str:
        alone_ms, beside_ms = self.alone_s * 1e3, self.beside_s * 1e3
        found = f"{alone_ms:.1f} ms alone, {beside_ms:.1f} ms beside, ratio {self.ratio:.3f}"
        if self.ratio_low is None:
            return found
        return f"{found} (95 %: {self.ratio_low:.3f} to {self.ratio_high:.3f})"


@dataclass(frozen=True, slots=True)
class SiteChange:
    """What the other execution does to one site's.

    `seconds` is from publishing to answer, `network` the share outside the server (None onboard);
    `cpu_share` is the median of cpu_s / run_s alone, about 0 for a task that waits; None: not measured.
    """

    seconds: Change
    network: Change | None
    cpu_share: float | None


@dataclass(frozen=True, slots=True)
class Disturbance:
    """The change by site over `plans` plans; `skipped` counts the records that are of no whole plan."""

    plans: int
    skipped: int
    sites: Mapping[str, SiteChange]

    def lines(self) -> list[str]:
        """For people."""
        found = [
            f"Disturbance, from {self.plans} plans, each run on each site alone and on both at once "
            f"({self.skipped} records of no whole plan):"
        ]
        for site, change in self.sites.items():
            found.append(f"{site}, beside {OTHER[site]}: {change.seconds}")
            if change.network is not None:
                found.append(f"{site}, outside the server: {change.network}")
            if change.cpu_share is not None:
                found.append(f"{site}, CPU time alone: {change.cpu_share:.0%} of the time that the task ran")
        return found

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


def measure(path: Path, *, seed: int = SEED) -> Disturbance | None:
    """The disturbance in a trace of `robot-client --alone`; None where no plan ran well in all three ways."""
    plans, skipped = _plans(list(_runs(path)))
    if not plans:
        return None
    return Disturbance(len(plans), skipped, {site: _site_change(plans, site, seed) for site in OTHER})


@dataclass(frozen=True, slots=True)
class _Times:
    """Of one execution."""

    seconds: float
    network_s: float | None
    cpu_share: float | None


@dataclass(frozen=True, slots=True)
class _Run:
    """One record: where it ran well, and nothing where it ran ill anywhere."""

    size: float
    times: Mapping[str, _Times]


_Plan = Mapping[frozenset[str], Mapping[str, _Times]]  # by the sites it ran on


def _plans(runs: Sequence[_Run]) -> tuple[list[_Plan], int]:
    """Every three neighbours that are one plan in its three ways, and how many records are left over."""
    found: list[_Plan] = []
    at = 0
    while at < len(runs):
        three = runs[at : at + len(WAYS)]
        plan = {frozenset(run.times): run.times for run in three}
        if set(plan) == set(WAYS) and len({run.size for run in three}) == 1:
            found.append(plan)
            at += len(WAYS)
        else:
            at += 1
    return found, len(runs) - len(WAYS) * len(found)


def _site_change(plans: Sequence[_Plan], site: str, seed: int) -> SiteChange:
    pairs = [(plan[frozenset({site})][site], plan[frozenset(OTHER)][site]) for plan in plans]
    seconds = [(alone.seconds, beside.seconds) for alone, beside in pairs]
    network = [  # onboard has none
        (alone.network_s, beside.network_s)
        for alone, beside in pairs
        if alone.network_s is not None and beside.network_s is not None and alone.network_s >= LEAST_S
    ]
    shares = [alone.cpu_share for alone, _ in pairs if alone.cpu_share is not None]
    return SiteChange(
        _change(seconds, seed),
        _change(network, seed) if network else None,
        statistics.median(shares) if shares else None,
    )


def _change(pairs: Sequence[tuple[float, float]], seed: int) -> Change:
    alone_s, beside_s = np.array(pairs).T
    ratios = beside_s / alone_s
    # A plan is measured apart from the next one, so each is drawn by itself.
    low, high = Blocks(len(pairs), length=1, seed=seed).intervals(
        lambda picks: {"ratio": np.median(ratios[picks], axis=1)}
    )
    alone_median_s, beside_median_s, ratio = (float(np.median(x)) for x in (alone_s, beside_s, ratios))
    return Change(len(pairs), alone_median_s, beside_median_s, ratio, low.get("ratio"), high.get("ratio"))


def _runs(path: Path) -> Iterator[_Run]:
    for line, fields in enumerate(trace.read(path), 1):
        where = f"{path}:{line}"
        try:
            ran = fields["executions"]
            good = all(one["ok"] and not one["censored"] for one in ran)
            times = {one["site"]: _times(where, one) for one in ran} if good else {}
        except (TypeError, KeyError) as error:
            holds = "site, seconds, ok, censored, run_s, network_s"
            raise DataError(f"{where}: executions: {error!r}; each holds {holds}") from None
        yield _Run(_number(f"{where}: size", fields["size"]), times)


def _times(where: str, one: Mapping[str, Any]) -> _Times:
    def number(name: str, low: float = 0.0) -> float:
        return _number(f"{where}: {name} of {one['site']}", one[name], low)

    network_s = None if one["network_s"] is None else number("network_s")
    # Traces from before it was measured lack cpu_s, and an older server does not send it.
    share = None if one.get("cpu_s") is None else number("cpu_s") / number("run_s", LEAST_S)
    return _Times(number("seconds", LEAST_S), network_s, share)


def _number(what: str, value: Any, low: float = 0.0) -> float:
    """The value where it is a number that can be computed with; DataError, with what it is, where not."""
    if type(value) not in (int, float) or not low <= value <= VALUE_MAX:
        raise DataError(f"{what}: {value!r:.{SHOWN_MAX}} is not a number from {low:g} to {VALUE_MAX:g}")
    return float(value)
