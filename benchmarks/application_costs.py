"""What the tasks of an application cost, measured on one core, for robots that are simulated.

    taskset -c 0 python -m benchmarks.application_costs arm apriltags registration

Each writes benchmarks/costs/NAME.csv, a row for each task: its size, its work if its answers report it, CPU
seconds, and the bytes of request and answer. NAME.json says how it was measured.
"""

import argparse
import importlib
import itertools
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from random import Random

import numpy as np

from examples.measure import row
from offboard.common.command_line import run_command
from offboard.common.tasks import kinds
from offboard.loadgen.play.machine import commit_here, machine
from offboard.loadgen.simulation.model.task_costs import COSTS, Cost, RobotTasks, SimulatedTask
from offboard.loadgen.table.measured_rows import write_whole
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

PROG = "python -m benchmarks.application_costs"
FOLDER = Path(__file__).parent / "costs"
NAMES = ("arm", "apriltags", "registration")
TASKS = 300
SEED = 1
COLUMNS = ("bytes_out", "bytes_in", "cpu_s", "size", "work")
SENDING_S = COSTS["look_at_frame"].sending_s  # of the robot, for requests of up to a megabyte


def main(argv: Sequence[str]) -> int:
    return run_command(PROG, lambda: _run(argv))


def _run(argv: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(prog=PROG, description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="+", choices=NAMES, metavar="NAME", help=", ".join(NAMES))
    for name in parser.parse_args(argv).names:
        rows = measured(name)
        lines = [",".join(COLUMNS), *(",".join(f"{value:.9g}" for value in one) for one in rows)]
        write_whole(FOLDER / f"{name}.csv", "\n".join(lines) + "\n")
        about = {"commit": commit_here(), "seed": SEED, "machine": machine()}
        write_whole(FOLDER / f"{name}.json", json.dumps(about, indent=1) + "\n")
        print(f"{name}: {TASKS} tasks, mean CPU time {1e3 * np.mean([one[2] for one in rows]):.1f} ms")
    return 0


def measured(name: str) -> list[tuple[float, ...]]:
    """The rows of an application."""
    module = importlib.import_module(f"examples.{name}")
    kind = next(one for one in kinds() if one.function.__module__ == module.__name__)
    engine = () if kind.setup is None else (kind.setup(),)
    return [row(kind, engine, args) for args in itertools.islice(module.inputs(SEED), TASKS)]


def tasks_of(name: str, seed: int) -> RobotTasks:
    """The tasks of a simulated robot that cost as much, in an order that the seed draws."""
    rows = np.loadtxt(FOLDER / f"{name}.csv", delimiter=",", skiprows=1).tolist()
    Random(seed).shuffle(rows)
    tasks = []
    for bytes_out, bytes_in, cpu_s, size, work in rows:
        task = SimulatedTask(size, {ONBOARD: cpu_s, CLOUD: cpu_s}, int(bytes_out), int(bytes_in))
        tasks.append(task if math.isnan(work) else replace(task, answer=work))
    cost = Cost(fixed_s=0.0, s_per_unit=1.0, sending_s=SENDING_S)
    return RobotTasks(tasks, cost, reports_work=tasks[0].answer is not None)


def mean_cpu_s(name: str) -> float:
    """The mean CPU seconds of its tasks."""
    return float(
        np.loadtxt(FOLDER / f"{name}.csv", delimiter=",", skiprows=1)[:, COLUMNS.index("cpu_s")].mean()
    )


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
