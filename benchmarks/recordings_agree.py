"""Plays recorded links on real processes, and in simulation with the costs of tasks on this machine.

`python -m benchmarks.recordings_agree link-plans`: for each recording of a folder, the mean of the default
over that of the better constant. It is simulated twice: with the costs of `task_costs.py`, which are those of
another machine, and with those that three runs over a link without a recording have shown here.
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
from offboard.loadgen.compare.recording_table import geometric
from offboard.loadgen.compare.recordings import RecordedLink, figures_of, find_recordings, over
from offboard.loadgen.compare.runs import play_once
from offboard.loadgen.play.run_files import ROBOT_SEED_STEP, RobotFiles
from offboard.loadgen.robot_files import read_trace
from offboard.loadgen.scenario.outcome import Outcome
from offboard.loadgen.scenario.scenario import Scenario
from offboard.loadgen.scenario.scenario_file import find_scenario, read_scenario
from offboard.loadgen.simulation import simulated_testbed
from offboard.loadgen.simulation.model.task_costs import DECIDING_CPU_S, Cost, RobotTasks, find_tasks
from offboard.loadgen.simulation.simulated_run import simulate
from offboard.loadgen.testbed.testbed import ROBOT
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

POLICIES = ("default", ONBOARD, CLOUD)
STOLEN_MAX = 12.0
DIFFER_MAX = 0.05
MEASURED_TASKS = 100


@dataclass(frozen=True, slots=True)
class Costs:
    """What a task costs, and the CPU seconds of the robot to decide about one; None: as `task_costs` says."""

    task: Cost | None = None
    deciding_s: float = DECIDING_CPU_S


def measure(scenario: Scenario, out: Path) -> Costs:
    """The costs by the traces of each policy over the link of the scenario without its recording."""
    link = {key: value for key, value in scenario.link.items() if "recording" not in key}
    steady = replace(scenario, name=f"{scenario.name}-steady", link=link)
    steady = steady.changed(tasks=MEASURED_TASKS, reference=0)
    records: dict[str, list[Mapping[str, Any]]] = {}
    for policy in POLICIES:
        folder = out / steady.name / policy
        play_once(steady.changed(policy=policy), folder, "local", STOLEN_MAX)
        records[policy] = list(read_trace(next(iter(RobotFiles.of(steady, folder))).trace))
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
        line["waited_s"] - line["executions"][0]["seconds"]
        for line in records["default"]
        if len(line["executions"]) == 1
    )
    slope, fixed_s = map(float, lines[ONBOARD])
    cpus = scenario.robot.cpus
    cost = Cost(max(0.0, fixed_s), slope, max(0.0, cpus * sending_s))
    costs = Costs(cost, max(0.0, cpus * deciding_s))
    print(f"{steady.name}: {costs}; on the server {lines[CLOUD]}", file=sys.stderr)
    return costs


def runs_of(
    records: Iterable[Mapping[str, Any]], site: str
) -> Iterator[tuple[Mapping[str, Any], Mapping[str, Any]]]:
    """The good runs on a site, each with the line of its task."""
    for line in records:
        for one in line["executions"]:
            if one["site"] == site and one["ok"]:
                yield line, one


def tasks_of(scenario: Scenario) -> dict[str, RobotTasks]:
    return {
        name: find_tasks(scenario.workload, scenario.seed + n * ROBOT_SEED_STEP, scenario.workload.tasks)
        for n, name in enumerate(scenario.robots())
    }


def simulated(scenario: Scenario, tasks: Mapping[str, RobotTasks], costs: Costs) -> Outcome:
    simulated_testbed.DECIDING_CPU_S = costs.deciding_s
    if costs.task is not None:
        tasks = {name: replace(one, cost=costs.task) for name, one in tasks.items()}
    return simulate(scenario, tasks)


def ratio(
    link: RecordedLink, scenario: Scenario, runs: Mapping[str, Outcome]
) -> tuple[float, dict[str, float]]:
    """The default over the better constant, and the mean of each policy in milliseconds."""
    compared = scenario.compared()
    found = figures_of(link.family, link.name, {name: [run.of(compared)] for name, run in runs.items()})
    return found.mean_ratio("default"), {name: 1e3 * found.taken[name].mean_s for name in POLICIES}


def compare(name: str, links: Sequence[RecordedLink], tasks: int, out: Path) -> Table:
    """A line for each recording; the last one has the geometric means."""
    scenario = read_scenario(find_scenario(name)).changed(tasks=tasks, reference=0)
    costs, rows, ratios = measure(scenario, out), [], []
    for n, link in enumerate(links):
        unit = over(scenario, link, scenario.seed)
        known = tasks_of(unit)
        ways: list[dict[str, Outcome]] = [{}]
        for policy in (*POLICIES[n % 3 :], *POLICIES[: n % 3]):  # each comes first equally often
            played = play_once(unit.changed(policy=policy), out / unit.name / policy, "local", STOLEN_MAX)
            ways[0][policy] = played.outcome
        for way in (Costs(), costs):
            ways.append({one: simulated(unit.changed(policy=one), known, way) for one in POLICIES})
        found = [ratio(link, unit, way) for way in ways]
        ratios.append([one for one, _ in found])
        means = [" / ".join(f"{ms[policy]:.0f}" for policy in POLICIES) for _, ms in found]
        rows.append([link.name, *(f"{one:.3f}" for one in ratios[-1]), *means])
        print(" | ".join(rows[-1]), file=sys.stderr, flush=True)
    all_of = [geometric([one[way] for one in ratios]) for way in range(3)]
    rows.append(["geometric mean", *(f"{one:.3f}" for one in all_of), "", "", ""])
    names = ("processes", "simulation", "simulation, costs of this machine")
    columns = ["recording", *names, *(f"{one}: default / onboard / cloud, ms" for one in names)]
    differ = Requirement("processes and simulation differ by", abs(all_of[2] / all_of[0] - 1), DIFFER_MAX)
    title = f"{name}: {tasks} tasks over each recording, default over the better constant"
    return Table(title, columns, rows, [differ])


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.recordings_agree", description=__doc__)
    parser.add_argument("scenario", nargs="+", help="some of link-plans, link-frames and link-images")
    parser.add_argument(
        "--recordings", type=Path, default=Path("loadgen/links"), help="(default: %(default)s)"
    )
    parser.add_argument("--tasks", type=int, default=300, help="over each recording (default: %(default)s)")
    parser.add_argument(
        "--out", type=Path, default=Path("out/recordings-agree"), help="(default: %(default)s)"
    )
    flags = parser.parse_args()
    links = find_recordings(flags.recordings)
    failed = 0
    for name in flags.scenario:
        table = compare(name, links, flags.tasks, flags.out)
        print(table, flush=True)
        failed += sum(not requirement.holds for requirement in table.requirements)
    return failed


if __name__ == "__main__":
    sys.exit(main())
