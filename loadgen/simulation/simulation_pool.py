"""A pool of processes that simulate scenarios; the number of processes does not change the results."""

import logging
import multiprocessing
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any

from offboard.loadgen.play.run_files import ROBOT_SEED_STEP
from offboard.loadgen.progress import progress
from offboard.loadgen.scenario.outcome import Outcome
from offboard.loadgen.scenario.scenario import Scenario, Workload
from offboard.loadgen.simulation.child_processes import end_quietly, starting
from offboard.loadgen.simulation.model.task_costs import OTHERS_TASKS_MAX, RobotTasks, find_tasks
from offboard.loadgen.simulation.simulated_run import simulate
from offboard.loadgen.testbed.testbed import ROBOT

# The settings of a workload that its tasks depend on.
MAKES_TASKS = (
    "map",
    "task",
    "inputs",
    "sizes",
    "resolution",
    "planner",
    "jump",
    "obstacles",
    "radius_m",
    "stream_hz",
    "stream_horizon",
    "stream_onboard_ms",
    "stream_cloud_ms",
)
Wanted = tuple[Workload, int]  # a robot: its workload and its seed


class SimulationPool:
    """Simulates with `jobs` processes; None means one for each CPU. A context manager."""

    def __init__(self, jobs: int | None = None) -> None:
        self._jobs = jobs or os.cpu_count() or 1
        self._pool: ProcessPoolExecutor | None = None
        self._known: dict[Wanted, RobotTasks] = {}

    def __enter__(self) -> "SimulationPool":
        if self._jobs > 1:
            # A planner that was compiled in this process does not survive a fork.
            context = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(self._jobs, context, initializer=_begin_child)
        _silence()
        return self

    def __exit__(self, *_: object) -> None:
        logging.disable(logging.NOTSET)
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def map(self, do: Callable[..., Any], *units: Sequence[Any]) -> Iterator[Any]:
        """The built-in `map`, on all processes."""
        if self._pool is None:
            return map(do, *units)
        with starting():  # the pool starts its processes with the first units
            return self._pool.map(do, *units)

    def play(self, scenarios: Sequence[Scenario], strategies: Mapping[str, Any]) -> dict[str, list[Outcome]]:
        """Play every scenario with every strategy; the scenarios differ only in their seed.

        A strategy holds arguments of `Scenario.changed`. The result has the outcomes of each strategy, in the
        order of the scenarios.
        """
        wanted = [_wanted(scenario) for scenario in scenarios]
        self._find([robot for robots in wanted for robot in robots.values()])
        units = [
            ([scenario.changed(**changes) for changes in strategies.values()], self._tasks(robots))
            for scenario, robots in zip(scenarios, wanted, strict=True)
        ]
        played: dict[str, list[Outcome]] = {name: [] for name in strategies}
        with progress("simulating", len(scenarios), every=1) as shown:
            for scenario, outcomes in zip(scenarios, self.map(_simulate_all, units), strict=True):
                shown.step(partial("{}, seed {}: simulated".format, scenario.name, scenario.seed))
                for name, outcome in zip(strategies, outcomes, strict=True):
                    played[name].append(outcome)
        return played

    def _find(self, wanted: Iterable[Wanted]) -> None:
        """Find the tasks of all robots for which not enough tasks are known yet."""
        most: dict[Wanted, Workload] = {}
        for workload, seed in wanted:
            key = _key(workload, seed)
            known = len(self._known[key].tasks) if key in self._known else 0
            if workload.tasks > max(known, most[key].tasks if key in most else 0):
                most[key] = workload
        units = [(workload, key[1]) for key, workload in most.items()]
        with progress("running the tasks of each robot once", len(units)) as shown:
            for key, tasks in zip(most, self.map(_find_tasks, units), strict=True):
                self._known[key] = tasks
                shown.step()

    def _tasks(self, robots: Mapping[str, Wanted]) -> dict[str, RobotTasks]:
        return {
            name: self._known[_key(workload, seed)].first(workload.tasks)
            for name, (workload, seed) in robots.items()
        }


def _begin_child() -> None:
    end_quietly()
    _silence()


def _silence() -> None:
    """Turn off warnings: a thousand runs would repeat what robots log about their map and their sites."""
    logging.disable(logging.WARNING)


def _wanted(scenario: Scenario) -> dict[str, Wanted]:
    """The workload and the seed of each robot. Robots that only make load repeat a few tasks."""
    found: dict[str, Wanted] = {}
    for n, name in enumerate(scenario.robots()):
        count = scenario.workload.tasks
        few = count if name == ROBOT else min(count, OTHERS_TASKS_MAX)
        seed = scenario.seed + n * ROBOT_SEED_STEP
        found[name] = replace(scenario.workload, tasks=few, measure=0, alone=0), seed
    return found


def _key(workload: Workload, seed: int) -> Wanted:
    """The same key for all scenarios that have the same tasks."""
    return Workload(**{name: getattr(workload, name) for name in MAKES_TASKS}), seed


def _find_tasks(wanted: Wanted) -> RobotTasks:
    workload, seed = wanted
    return find_tasks(workload, seed, workload.tasks)


def _simulate_all(unit: tuple[Sequence[Scenario], Mapping[str, RobotTasks]]) -> list[Outcome]:
    scenarios, tasks = unit
    return [simulate(scenario, tasks) for scenario in scenarios]
