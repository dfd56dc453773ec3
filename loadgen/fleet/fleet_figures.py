"""The figures of a simulated fleet: times, regret, the shares of the servers, and how much robots herd.

Robots herd if many of them choose the same server at the same time, and later all leave it again.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from offboard.loadgen.fleet.fleet_run import Fleet
from offboard.loadgen.fleet.fleet_servers import SAMPLE_S
from offboard.loadgen.table.table_two_figures import quantile

LAG_S = 0.5  # as long as between two heartbeats: a herd would be somewhere else by then
SAMPLES_MIN = 20  # with fewer samples while all robots work, nothing is said about herds


@dataclass(frozen=True, slots=True)
class FleetLine:
    """One fleet. None: undefined.

    - `regret_ms`: mean time beyond the best site that the robot uses; `settled_ms`: that of the second half
      of each robot's tasks.
    - `busiest`, `idlest`: the used time of the busiest and of the idlest server, over the mean of all.
    - `uneven`: standard deviation of the requests at the servers at one moment, over their mean.
    - `repeats`: autocorrelation of a server's requests after LAG_S, without what all servers have in common.
    """

    robots: int
    servers: int
    workers: int
    tasks: int
    mean_ms: float
    p99_ms: float
    regret_ms: float
    settled_ms: float
    busiest: float | None
    idlest: float | None
    uneven: float | None
    repeats: float | None
    onboard_percent: float
    probe_percent: float
    took_s: float
    note: str = ""


def line_of(fleet: Fleet, start_s: float, took_s: float) -> FleetLine:
    """The figures of a fleet whose simulation took `took_s` seconds."""
    waited_s = np.array([[one.waited_s for one in robot] for robot in fleet.done])
    regret_s, half = waited_s - fleet.oracle_s, waited_s.shape[1] // 2
    mean_s = float(fleet.busy_s.mean())
    uneven, repeats = herding(_while_all_work(fleet, start_s))
    done = [one for robot in fleet.done for one in robot]
    return FleetLine(
        robots=fleet.size.robots,
        servers=fleet.size.servers,
        workers=fleet.size.workers,
        tasks=waited_s.size,
        mean_ms=1e3 * float(waited_s.mean()),
        p99_ms=1e3 * float(quantile(waited_s.ravel(), 99)),
        regret_ms=1e3 * float(regret_s.mean()),
        settled_ms=1e3 * float(regret_s[:, half:].mean()),
        busiest=float(fleet.busy_s.max()) / mean_s if mean_s else None,
        idlest=float(fleet.busy_s.min()) / mean_s if mean_s else None,
        uneven=uneven,
        repeats=repeats,
        onboard_percent=100 * sum(one.server < 0 for one in done) / len(done),
        probe_percent=100 * sum(one.probed for one in done) / len(done),
        took_s=took_s,
    )


def herding(samples: NDArray[np.int32]) -> tuple[float | None, float | None]:
    """`uneven` and `repeats` of `FleetLine`, from samples with one row for each moment."""
    if len(samples) < SAMPLES_MIN or samples.shape[1] < 2 or not samples.any():
        return None, None
    beyond = samples - samples.mean(axis=1, keepdims=True)
    beyond = beyond - beyond.mean(axis=0)  # what a server always has more than the others is no herd
    variance, lag = float((beyond**2).mean()), round(LAG_S / SAMPLE_S)
    if not variance:
        return 0.0, None
    return variance**0.5 / float(samples.mean()), float((beyond[lag:] * beyond[:-lag]).mean()) / variance


def _while_all_work(fleet: Fleet, start_s: float) -> NDArray[np.int32]:
    """The samples from when the last robot has started until the first one ends."""
    ends_s = min(robot[-1].started_s for robot in fleet.done)
    return fleet.samples[round(start_s / SAMPLE_S) : max(0, round(ends_s / SAMPLE_S))]
