"""Robots that share one worker: how long their answers take together and alone, and what they predict."""

import random
import statistics
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np

from benchmarks.measure import Requirement, Table
from benchmarks.servers import cloud_server
from examples.shared_gpu import UNITS, infer, infer_alone, infer_at_once, network, network_alone
from offboard import Offloader

TASKS = "examples.shared_gpu"
ROBOTS = 8
LOOP_S, LEARNING_S = 10.0, 2.0  # of a closed loop, and how much of it is not counted
PREDICTED_S = 45.0
FIRST = 15  # tasks of each robot whose predictions do not count
PAUSE_S = 0.3  # the longest pause of a robot between two tasks
WAIT_S = 20.0


class Asked(NamedTuple):
    """One task: when it began, how long it took, and what was predicted."""

    at_s: float
    seconds: float
    predicted_s: float | None
    interval: tuple[float, float] | None


def tables() -> Iterator[Table]:
    yield closed_loops()
    yield predictions()


def closed_loops() -> Table:
    """Eight robots that ask again as soon as they have their answer."""
    cases: dict[str, tuple[Callable[..., Any], Any]] = {
        "together": (infer, 1.0),
        "together, never waiting": (infer_at_once, 1.0),
        "one at a time": (infer_alone, 1.0),
        "a network on the CPU, together": (network, np.ones(UNITS, np.float32)),
        "a network on the CPU, one at a time": (network_alone, np.ones(UNITS, np.float32)),
    }
    mean_s, per_s, rows = dict[str, float](), dict[str, float](), []
    for name, (function, item) in cases.items():
        with cloud_server(TASKS, CLOUD_WORKERS="1", CLOUD_EXECUTOR="threads") as server:
            asked = drive(server.endpoint, function, item, robots=ROBOTS, for_s=LOOP_S)
        first_s = min(one.at_s for one in asked)
        counted = [one for one in asked if one.at_s - first_s > LEARNING_S]
        mean_s[name] = statistics.mean(one.seconds for one in counted)
        per_s[name] = len(counted) / (LOOP_S - LEARNING_S)
        rows.append([name, f"{1000 * mean_s[name]:.0f}", f"{per_s[name]:.1f}"])
    gain = per_s["together"] / per_s["one at a time"]
    requirements = [
        Requirement("mean answer, together", 1000 * mean_s["together"], 350.0, "ms"),
        Requirement("answers a second, together over one at a time", gain, 3.0, at_least=True),
    ]
    return Table(f"{ROBOTS} robots on one worker", ["runs", "mean, ms", "answers/s"], rows, requirements)


def predictions() -> Table:
    """Robots with pauses of random length: the prediction before each task, and the time that it took."""
    rows, requirements = [], []
    for robots in (1, 4, 16):
        with cloud_server(TASKS, CLOUD_WORKERS="1", CLOUD_EXECUTOR="threads") as server:
            asked = drive(
                server.endpoint, infer, 1.0, robots=robots, for_s=PREDICTED_S, pause_s=PAUSE_S, first=FIRST
            )
        known = [one for one in asked if one.predicted_s is not None and one.interval is not None]
        took_s = statistics.mean(one.seconds for one in known)
        bias = statistics.mean(one.predicted_s or 0.0 for one in known) / took_s - 1.0
        held = statistics.mean(
            one.interval[0] <= one.seconds <= one.interval[1] for one in known if one.interval is not None
        )
        rows.append([str(robots), f"{1000 * took_s:.0f}", f"{100 * bias:+.1f}", f"{100 * held:.0f}"])
        requirements += [
            Requirement(f"bias with {robots} robots", 100 * abs(bias), 10.0, "%"),
            Requirement(f"90 % interval with {robots} robots", 100 * held, 85.0, "%", at_least=True),
        ]
    columns = ["robots", "mean, ms", "bias, %", "in the 90 % interval, %"]
    return Table("Predictions on a shared worker", columns, rows, requirements)


def drive(
    endpoint: str,
    function: Callable[..., Any],
    item: Any,
    *,
    robots: int,
    for_s: float,
    pause_s: float = 0.0,
    first: int = 0,
) -> list[Asked]:
    """What this many robots ask for this long; without the first tasks of each."""
    ready = threading.Barrier(robots)

    def robot(number: int) -> list[Asked]:
        draw, asked = random.Random(number), []
        with Offloader.connect(endpoint) as offload:
            offload.wait_for_sites(function, WAIT_S)
            ready.wait(WAIT_S)
            until_s = time.monotonic() + for_s
            while time.monotonic() < until_s:
                began_s = time.monotonic()
                _, record = offload.call(function, item, where="cloud", timeout_s=WAIT_S)
                (run,) = [one for one in record.executions if one.site == "cloud"]
                site = record.sites["cloud"]
                low_s, high_s = site.low_s, site.high_s
                interval = None if low_s is None or high_s is None else (low_s, high_s)
                asked.append(Asked(began_s, run.seconds, site.predicted_s, interval))
                time.sleep(draw.uniform(0.0, pause_s))
        return asked[first:]

    with ThreadPoolExecutor(robots) as pool:
        return [one for found in pool.map(robot, range(robots)) for one in found]
