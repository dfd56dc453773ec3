"""Lower bounds of two simulated scenarios: times that no policy can beat without foreseeing random draws."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.measure import Table
from offboard.loadgen.scenario.outcome import Reference
from offboard.loadgen.scenario.scenario_file import find_scenario, read_scenario
from offboard.loadgen.simulation.simulation_pool import SimulationPool
from offboard.robot_client import policies
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

SEEDS, TASKS, FROM_TASK = 6, 500, 20
ALLOWANCES = (0.0, 0.05, 0.1, 0.2)  # second runs per task
PRICES_S = np.linspace(0.0, 0.3, 61)  # of one second run
STARTS = 250  # instants at which the second site may start, at quantiles of the answer times
DRAWS = 400  # of the round trip
PERCENTILE = 95

Column = NDArray[np.float64]


def tables() -> list[Table]:
    return [_mean_of_lossy(), _tail_of_heavy_tail()]


def _played(scenario: str, *names: str) -> dict[str, list[Reference]]:
    one = read_scenario(find_scenario(scenario)).changed(tasks=TASKS)
    seeds = [replace(one, seed=one.seed + n) for n in range(SEEDS)]
    with SimulationPool(1) as pool:
        played = pool.play(seeds, {name: {"policy": name} for name in names})
    return {
        name: [one for run in runs for one in run.references if one.i >= FROM_TASK]
        for name, runs in played.items()
    }


def _mean_of_lossy() -> Table:
    """The lowest possible mean time for a given mean number of second runs, computed from the dual problem.

    A plan is a first site, and the instant at which the other site starts if the first has not answered. The
    robot knows the CPU time of each task on both sites, and the distribution of the round trip.
    """
    found = _played("lossy", ONBOARD)[ONBOARD]
    both = [one.seconds for one in found if CLOUD in one.seconds]
    onboard, cloud = (np.array([seconds[site] for seconds in both]) for site in (ONBOARD, CLOUD))
    server = read_scenario(find_scenario("lossy")).robot.cpus * onboard  # time on a full CPU
    way = np.quantile(cloud - server, (np.arange(DRAWS) + 0.5) / DRAWS)
    plans = _plans(onboard, server, way)
    oracle_s = float(np.minimum(onboard, cloud).mean())
    rows = []
    for allowance in ALLOWANCES:
        dual = [
            np.min([seconds + price_s * runs for seconds, runs in plans], axis=0).mean() - price_s * allowance
            for price_s in PRICES_S
        ]
        rows.append([f"{allowance:.0%}", f"{max(dual) / oracle_s:.3f}"])
    rows.append(["always onboard", f"{onboard.mean() / oracle_s:.3f}"])
    return Table(
        "lossy: lowest possible mean time",
        ("second runs per task", "mean time, relative to the oracle"),
        rows,
    )


def _plans(onboard: Column, server: Column, way: Column) -> list[tuple[Column, Column]]:
    """For each plan, the expected seconds and second runs of each task."""
    cloud = server[:, np.newaxis] + way
    plans = [(onboard, np.zeros(len(onboard))), (cloud.mean(axis=1), np.zeros(len(onboard)))]
    answers = np.concatenate([onboard, cloud[:: len(cloud) // DRAWS + 1].ravel()])
    for start_s in [0.0, *np.quantile(answers, np.linspace(0.0, 1.0, STARTS))]:
        late = cloud > start_s
        hedged = np.where(late, np.minimum(cloud, start_s + onboard[:, np.newaxis]), cloud)
        plans.append((hedged.mean(axis=1), late.mean(axis=1)))
        late_onboard = onboard > start_s
        helped = np.minimum(onboard[:, np.newaxis], start_s + cloud).mean(axis=1)
        plans.append((np.where(late_onboard, helped, onboard), late_onboard.astype(np.float64)))
    return plans


def _tail_of_heavy_tail() -> Table:
    """The 95th percentile of a policy that knows the time of each task on each site, and of two real ones."""
    names = ("paper", policies.DEFAULT)
    played = _played("heavy-tail", *names)
    waited = {name: [_waited_s(one) for one in found] for name, found in played.items()}
    waited["oracle"] = [min(one.seconds.values()) for one in played["paper"]]
    rows = [
        [name, f"{1e3 * at:.1f}", f"{at / _percentile(waited['paper']):.3f}"]
        for name, seconds in waited.items()
        for at in [_percentile(seconds)]
    ]
    return Table("heavy-tail: 95th percentile of the time", ("policy", "ms", "relative to paper"), rows)


def _waited_s(one: Reference) -> float:
    seconds = one.sent_s
    assert seconds is not None, "a simulation has a reference for every task"
    return seconds


def _percentile(seconds: Sequence[float]) -> float:
    return float(np.percentile(seconds, PERCENTILE))
