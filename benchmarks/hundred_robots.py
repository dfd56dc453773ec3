"""A hundred real robots on four real servers for two minutes, next to a simulation of the same fleet.

`python -m benchmarks.hundred_robots robots FIRST COUNT ENDPOINT ...` runs some of the robots: it prints
"ready" when they are connected, begins when it reads a line, and prints their tasks as JSON.
"""

import contextlib
import json
import random
import sys
import threading
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from subprocess import Popen

import numpy as np

from benchmarks.measure import Requirement, Table
from benchmarks.servers import READY_S, cloud_server, running
from benchmarks.tasks import ONBOARD_FACTOR, hash_near_or_far
from offboard.loadgen.fleet.fleet_run import SPREAD, make_tasks, run_fleet
from offboard.loadgen.fleet.fleet_servers import server_of
from offboard.loadgen.fleet.fleet_settings import FleetConfig
from offboard.loadgen.progress import progress
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.settings import Settings
from offboard.robot_client.sites.runner import ONBOARD

ROBOTS, SERVERS, PROCESSES = 100, 4, 4
TASKS, PERIOD_S, START_S = 120, 1.0, 20.0  # of each robot, from task to task, and over which the robots start
ROUNDS = 6_000
SEED = 1

Done = tuple[float, str, int]  # seconds from when it was due, where it was sent, on how many sites it ran


def tables() -> list[Table]:
    with contextlib.ExitStack() as stack:
        servers = [stack.enter_context(cloud_server(CLOUD_WORKERS="1")) for _ in range(SERVERS)]
        real = _play(stack, [server.endpoint for server in servers])
    rows = [_row("real", real), _row("simulated", _simulated())]
    lost = ROBOTS * TASKS - len(real)
    columns = ("fleet", "tasks", "mean ms", "P99 ms", "onboard %", "on two sites %", "busiest / mean")
    title = f"{ROBOTS} robots and {SERVERS} servers, {TASKS} tasks for each robot, one in {PERIOD_S:g} s"
    return [Table(title, columns, rows, [Requirement("tasks without an answer", lost, 0)])]


def _play(stack: contextlib.ExitStack, endpoints: Sequence[str]) -> list[Done]:
    """The tasks of all real robots."""
    each, processes = ROBOTS // PROCESSES, list[Popen[str]]()
    for first in range(0, ROBOTS, each):
        command = [sys.executable, "-m", "benchmarks.hundred_robots", "robots", str(first), str(each)]
        processes.append(stack.enter_context(running([*command, *endpoints])))
    outputs = [process.stdout for process in processes if process.stdout is not None]
    for output in outputs:
        if output.readline() != "ready\n":
            raise RuntimeError("robots could not connect")
    for process in processes:
        print(file=process.stdin, flush=True)
    return [(*done,) for output in outputs for done in json.loads(output.readline())]


def _simulated() -> list[Done]:
    """The same fleet in simulation. Its link is the shortest that can be simulated."""
    config = FleetConfig(
        robots=(ROBOTS,), servers=(SERVERS,), workers_per_robot=SERVERS / ROBOTS, tasks=TASKS,
        rounds=ROUNDS, robot_cpus=1 / ONBOARD_FACTOR, start_s=START_S, delay_ms=1.0, seed=SEED,
    )  # fmt: skip
    tasks, (size,) = make_tasks(config), config.fleets()
    config = replace(config, load=size.period_s(tasks.cost.cpu_s(ROUNDS), 1.0) / PERIOD_S)
    with progress("simulating", ROBOTS * TASKS) as shown:
        fleet = run_fleet(config, size, tasks, jobs=1, shown=shown)
    return [
        (one.waited_s, ONBOARD if one.server < 0 else server_of(one.server).site, one.runs)
        for robot in fleet.done
        for one in robot
    ]


def _row(name: str, done: Sequence[Done]) -> list[str]:
    seconds, sites = np.array([one[0] for one in done]), Counter(one[1] for one in done)
    servers = [count for site, count in sites.items() if site != ONBOARD]
    twice = sum(one[2] > 1 for one in done)
    figures = (1e3 * seconds.mean(), 1e3 * np.quantile(seconds, 0.99))
    shares = (100 * sites[ONBOARD] / len(done), 100 * twice / len(done))
    busiest = max(servers) * SERVERS / sum(servers)
    return [name, str(len(done)), *(f"{one:.1f}" for one in (*figures, *shares)), f"{busiest:.2f}"]


def run_robots(first: int, count: int, endpoints: Sequence[str]) -> None:
    sites = {server_of(n).site: endpoint for n, endpoint in enumerate(endpoints)}
    done: list[Done] = []
    with contextlib.ExitStack() as stack:
        robots = [
            stack.enter_context(Offloader.connect(sites=sites, settings=Settings(seed=first + n)))
            for n in range(count)
        ]
        for robot in robots:
            absent = robot.wait_for_sites(hash_near_or_far, READY_S)
            assert not absent, absent
        print("ready", flush=True)
        sys.stdin.readline()
        threads = [
            threading.Thread(target=_run_robot, args=(robot, SEED * ROBOTS + first + n, done))
            for n, robot in enumerate(robots)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    print(json.dumps(done), flush=True)


def _run_robot(robot: Offloader, seed: int, done: list[Done]) -> None:
    draws = random.Random(seed)
    due_s = time.perf_counter() + draws.uniform(0, START_S)
    for _ in range(TASKS):
        time.sleep(max(0.0, due_s - time.perf_counter()))
        began_s = time.perf_counter()
        robot(hash_near_or_far, round(ROUNDS * draws.uniform(1 - SPREAD, 1 + SPREAD)))
        ended_s, record = time.perf_counter(), robot.last
        assert record is not None, "every call leaves its record"
        done.append((ended_s - began_s, record.decision.site, len(record.executions)))
        due_s = max(due_s + draws.expovariate(1 / PERIOD_S), ended_s)


if __name__ == "__main__":
    _, _, first, count, *endpoints = sys.argv
    run_robots(int(first), int(count), endpoints)
