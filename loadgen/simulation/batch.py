"""Simulated runs of scenarios by several processes; what comes of them does not depend on how many."""

import logging
import multiprocessing
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from typing import Any, Self

from offboard.loadgen.play.run_files import ROBOT_SEED_STEP
from offboard.loadgen.scenario.outcome import Outcome
from offboard.loadgen.scenario.scenario import Scenario, Workload
from offboard.loadgen.simulation.model.simulated_tasks import OTHERS_TASKS_MAX, Tasks, find_tasks
from offboard.loadgen.simulation.run import simulate
from offboard.loadgen.testbed.testbed import ROBOT

Wanted = tuple[Workload, int]  # whose tasks, and the seed of the robot


class Batch:
    """Plays with `jobs` processes (None: one a CPU). A context manager."""

    def __init__(self, jobs: int | None = None) -> None:
        self._jobs = jobs or os.cpu_count() or 1
        self._pool: ProcessPoolExecutor | None = None
        self._known: dict[Wanted, Tasks] = {}

    def __enter__(self) -> Self:
        if self._jobs > 1:
            # A planner that was compiled in this process does not survive a fork.
            context = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(self._jobs, context, initializer=_keep_quiet)
        _keep_quiet()
        return self

    def __exit__(self, *_: object) -> None:
        logging.disable(logging.NOTSET)
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def map(self, do: Callable[..., Any], *units: Sequence[Any]) -> Iterator[Any]:
        """As the built-in one, by all processes."""
        return self._pool.map(do, *units) if self._pool else map(do, *units)

    def play(self, scenarios: Sequence[Scenario], strategies: Mapping[str, Any]) -> dict[str, list[Outcome]]:
        """Each of `scenarios`, which differ in their seed, by every one of `strategies`.

        The outcomes come by strategy in the order of the seeds; a strategy is what `Scenario.changed` takes.
        """
        wanted = [_wanted(scenario) for scenario in scenarios]
        self._find([one for robots in wanted for one in robots.values()])
        units = [
            ([scenario.changed(**changes) for changes in strategies.values()], self._tasks(robots))
            for scenario, robots in zip(scenarios, wanted, strict=True)
        ]
        played: dict[str, list[Outcome]] = {name: [] for name in strategies}
        for scenario, outcomes in zip(scenarios, self.map(_simulate_all, units), strict=True):
            print(f"{scenario.name}, seed {scenario.seed}: simulated", file=sys.stderr, flush=True)
            for name, outcome in zip(strategies, outcomes, strict=True):
                played[name].append(outcome)
        return played

    def _find(self, wanted: Iterable[Wanted]) -> None:
        """The tasks of robots that are not known yet, or too few of them."""
        most: dict[Wanted, Workload] = {}
        for workload, seed in wanted:
            key = _key(workload, seed)
            known = len(self._known[key].asked) if key in self._known else 0
            if workload.tasks > max(known, most[key].tasks if key in most else 0):
                most[key] = workload
        units = [(workload, key[1]) for key, workload in most.items()]
        for key, tasks in zip(most, self.map(_find_tasks, units), strict=True):
            self._known[key] = tasks

    def _tasks(self, robots: Mapping[str, Wanted]) -> dict[str, Tasks]:
        return {
            name: self._known[_key(workload, seed)].first(workload.tasks)
            for name, (workload, seed) in robots.items()
        }


def _keep_quiet() -> None:
    """What robots say of their map and their sites is of no use a thousand times."""
    logging.disable(logging.WARNING)


def _wanted(scenario: Scenario) -> dict[str, Wanted]:
    """For each robot; those that only make load begin again after a few."""
    found: dict[str, Wanted] = {}
    for n, name in enumerate(scenario.robots()):
        count = scenario.workload.tasks
        few = count if name == ROBOT else min(count, OTHERS_TASKS_MAX)
        seed = scenario.seed + n * ROBOT_SEED_STEP
        found[name] = replace(scenario.workload, tasks=few, measure=0, alone=0), seed
    return found


def _key(workload: Workload, seed: int) -> Wanted:
    """Scenarios that ask for the same tasks have it in common."""
    plain = Workload(map=workload.map, task=workload.task, sizes=workload.sizes)
    return replace(
        plain,
        resolution=workload.resolution,
        planner=workload.planner,
        jump=workload.jump,
        obstacles=workload.obstacles,
        radius_m=workload.radius_m,
    ), seed


def _find_tasks(wanted: Wanted) -> Tasks:
    workload, seed = wanted
    return find_tasks(workload, seed, workload.tasks)


def _simulate_all(unit: tuple[Sequence[Scenario], Mapping[str, Tasks]]) -> list[Outcome]:
    scenarios, tasks = unit
    return [simulate(scenario, tasks) for scenario in scenarios]
