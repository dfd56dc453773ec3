"""Plays recorded links on real processes, and in simulation with the costs of tasks on this machine.

`python -m benchmarks.recordings_agree link-plans`: for each recording of a folder, the mean of the default over
that of the better constant. It is simulated twice: with the costs of `task_costs.py`, which are those of another
machine, and with those that three runs over a link without a recording have shown here.
"""

import argparse
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from benchmarks.measure import Requirement, Table
from offboard.loadgen.compare.recording_figures import figures_of
from offboard.loadgen.compare.recording_table import geometric
from offboard.loadgen.compare.recordings import RecordedLink, find_recordings, over
from offboard.loadgen.compare.resume import play_once
from offboard.loadgen.play.run_files import ROBOT_SEED_STEP, RobotFiles
from offboard.loadgen.robot_files import read_trace
from offboard.loadgen.scenario.outcome import Outcome
from offboard.loadgen.scenario.scenario import Scenario
from offboard.loadgen.scenario.scenario_file import find_scenario, read_scenario
from offboard.loadgen.simulation import simulated_testbed
from offboard.loadgen.simulation.model.simulated_tasks import RobotTasks, find_tasks
from offboard.loadgen.simulation.model.task_costs import Cost
from offboard.loadgen.simulation.simulated_run import simulate
from offboard.loadgen.testbed.testbed import ROBOT
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

POLICIES = ("default", ONBOARD, CLOUD)
STOLEN_MAX = 12.0
DIFFER_MAX = 0.05
MEASURED_TASKS = 100


@dataclass(frozen=True, slots=True)
class Costs:
    """What a task costs on this machine, and the CPU seconds of the robot to decide about one."""

    task: Cost
    deciding_s: float


def measure(scenario: Scenario, out: Path) -> Costs:
    """Play each policy over the link of the scenario without its recording, and take the costs from the traces."""
    link = {key: value for key, value in scenario.link.items() if "recording" not in key}
    steady = replace(scenario, name=f"{scenario.name}-steady", link=link).changed(
        tasks=MEASURED_TASKS, reference=0
    )
    records: dict[str, list[dict[str, Any]]] = {}
    for policy in POLICIES:
        folder = out / steady.name / policy
        play_once(steady.changed(policy=policy), folder, "local", STOLEN_MAX)
        records[policy] = list(read_trace(next(RobotFiles.of(steady, folder)).trace))
    tasks, lines = tasks_of(steady)[ROBOT].tasks, {}
    for site in (ONBOARD, CLOUD):
        runs = [(tasks[line["i"]].work[site], one["cpu_s"]) for line, one in runs_of(records[site], site)]
        lines[site] = np.polyfit(*zip(*runs, strict=True), 1)
    per_byte_s = 8e-6 / link["bandwidth_mbps"]
    sending_s = median(
        one["network_s"] - 2e-3 * link["delay_ms"] - per_byte_s * (one["bytes_out"] + one["bytes_in"])
        for _, one in runs_of(records[CLOUD], CLOUD)
    )
    deciding_s = median(
        line["waited_s"] - min(one["seconds"] for one in line["executions"] if one["ok"])
        for line in records["default"]
        if len(line["executions"]) == 1
    )
    slope, fixed_s = lines[ONBOARD]
    cpus = scenario.robot.cpus
    cost = Cost(max(0.0, float(fixed_s)), float(slope), max(0.0, cpus * sending_s))
    costs = Costs(cost, max(0.0, cpus * deciding_s))
    print(f"{steady.name}: {costs}; on the server {lines[CLOUD]}", file=sys.stderr)
    return costs


def runs_of(
    records: Sequence[Mapping[str, Any]], site: str
) -> Iterator[tuple[Mapping[str, Any], Mapping[str, Any]]]:
    for line in records:
        for one in line["executions"]:
            if one["site"] == site and one["ok"]:
                yield dict(line), one


def tasks_of(scenario: Scenario) -> dict[str, RobotTasks]:
    return {
        name: find_tasks(scenario.workload, scenario.seed + n * ROBOT_SEED_STEP, scenario.workload.tasks)
        for n, name in enumerate(scenario.robots())
    }


def simulated(scenario: Scenario, tasks: Mapping[str, RobotTasks], costs: Costs | None) -> Outcome:
    if costs is None:
        return simulate(scenario, tasks)
    simulated_testbed.DECIDING_CPU_S = costs.deciding_s
    return simulate(scenario, {name: replace(one, cost=costs.task) for name, one in tasks.items()})


def ratio(
    link: RecordedLink, scenario: Scenario, runs: Mapping[str, Outcome]
) -> tuple[float, dict[str, float]]:
    compared = scenario.compared()
    found = figures_of(link.family, link.name, {name: [run.of(compared)] for name, run in runs.items()})
    return found.mean_ratio("default"), {name: 1e3 * found.taken[name].mean_s for name in POLICIES}


def compare(name: str, links: Sequence[RecordedLink], tasks: int, out: Path) -> Table:
    scenario = read_scenario(find_scenario(name)).changed(tasks=tasks, reference=0)
    costs = measure(scenario, out)
    as_is = simulated_testbed.DECIDING_CPU_S
    rows, ratios = [], []
    for n, link in enumerate(links):
        unit = over(scenario, link, scenario.seed)
        known = tasks_of(unit)
        turned = (*POLICIES[n % 3 :], *POLICIES[: n % 3])
        played = {
            one: play_once(unit.changed(policy=one), out / unit.name / one, "local", STOLEN_MAX).outcome
            for one in turned
        }
        ways = [played]
        for way in (None, costs):
            simulated_testbed.DECIDING_CPU_S = as_is
            ways.append({one: simulated(unit.changed(policy=one), known, way) for one in POLICIES})
        found = [ratio(link, unit, way) for way in ways]
        ratios.append([one for one, _ in found])
        means = [" / ".join(f"{ms[policy]:.0f}" for policy in POLICIES) for _, ms in found]
        rows.append([link.name, *(f"{one:.3f}" for one in ratios[-1]), *means])
        print(" | ".join(rows[-1]), file=sys.stderr, flush=True)
    all_of = [geometric([one[way] for one in ratios]) for way in range(3)]
    rows.append(["geometric mean", *(f"{one:.3f}" for one in all_of), "", "", ""])
    ways = ("processes", "simulation", "simulation with the costs of this machine")
    columns = ["recording", *ways, *(f"ms, {way}: default / onboard / cloud" for way in ways)]
    differs = abs(all_of[2] / all_of[0] - 1)
    return Table(
        f"{name}: {tasks} tasks over each recording, default over the better constant",
        columns,
        rows,
        [Requirement("processes and simulation differ by", differs, DIFFER_MAX)],
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenario", nargs="+")
    parser.add_argument("--recordings", type=Path, default=Path("loadgen/links"))
    parser.add_argument("--tasks", type=int, default=300)
    parser.add_argument("--out", type=Path, default=Path("out/recordings-agree"))
    args = parser.parse_args()
    links = find_recordings(args.recordings)
    for name in args.scenario:
        print(compare(name, links, args.tasks, args.out), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
