"""The load that one server can take: empty tasks from many robots, and plans at 75 % of its capacity."""

import contextlib
import random
import statistics
import sys
import time
from collections.abc import Sequence
from concurrent.futures import Future
from pathlib import Path

import numpy as np

from benchmarks.measure import Requirement, Table
from benchmarks.servers import cloud_server, running, serve
from offboard.common.planning import planner
from offboard.common.planning.map_files import read_map
from offboard.common.planning.maps import free_pairs
from offboard.common.planning.planner import Point, Pose
from offboard.common.tasks import Task, kind_of
from offboard.robot_client.cloud.cloud_runner import CloudRunner
from offboard.robot_client.sites.runner import Execution

ROBOTS = (1, 10, 100, 1_000)
PROCESSES, IN_FLIGHT = 4, 32  # processes of robots, and tasks in flight of all robots together
CLIENTS, CLIENT_PROCESSES = 8, 2
TASKS = 6_000
ROUNDS = 5
PLANS, LOAD, WARM = 1_000, 0.75, 50
PERCENT = (50, 95, 99)
EXECUTORS = ("threads", "processes")
BUDGET_S = 60.0
Times = np.ndarray[tuple[int], np.dtype[np.float64]]
MAP = Path(__file__).parents[1] / "maps/willow-full-0.05.yaml"


def tables() -> list[Table]:
    with contextlib.ExitStack() as stack:
        ours = stack.enter_context(cloud_server()).endpoint
        echo = f"tcp://127.0.0.1:{serve(stack, 'echo')}"
        return [_robots(ours, echo), _clients(ours, echo), _loaded()]


def _robots(ours: str, echo: str) -> Table:
    rates: dict[int, list[tuple[float, float]]] = {robots: [] for robots in ROBOTS}
    wrong = 0
    for _ in range(ROUNDS):
        for robots in ROBOTS:
            rate, failed = _rate("raw", ours, robots, min(PROCESSES, robots))
            limit, _ = _rate("raw", echo, robots, min(PROCESSES, robots))
            rates[robots].append((rate, limit))
            wrong += failed
    middle = {
        robots: [statistics.median(each) for each in zip(*pairs, strict=True)]
        for robots, pairs in rates.items()
    }
    rows = [
        [f"{robots}", f"{rate:.0f}", f"{limit:.0f}", f"{rate / limit:.2f}"]
        for robots, (rate, limit) in middle.items()
    ]
    full = [middle[robots][0] for robots in ROBOTS[1:]]
    requirements = [
        Requirement(
            f"lowest / highest rate, from {ROBOTS[1]} robots on", min(full) / max(full), 0.8, at_least=True
        ),
        Requirement(f"wrong answers, with up to {ROBOTS[-1]} robots", wrong, 0),
    ]
    columns = ("robots", "offboard", "raw ROUTER echo", "offboard / echo")
    return Table("Empty tasks per second", columns, rows, requirements)


def _clients(ours: str, echo: str) -> Table:
    """The clients of Offboard compared to plain sockets: the cost of both ends."""
    found: list[tuple[float, float]] = []
    for _ in range(ROUNDS):
        rate, wrong = _rate("client", ours, CLIENTS, CLIENT_PROCESSES)
        if wrong:
            raise RuntimeError(f"{wrong} of {TASKS} answers were wrong")
        found.append((rate, _rate("raw", echo, CLIENTS, CLIENT_PROCESSES)[0]))
    rate, limit = (statistics.median(each) for each in zip(*found, strict=True))
    rows = [["offboard", f"{rate:.0f}"], ["raw ROUTER echo", f"{limit:.0f}"]]
    requirement = Requirement("offboard, relative to raw echo", rate / limit, 0.25, at_least=True)
    title = f"Empty tasks per second, pipelined from {CLIENTS} clients"
    return Table(title, ("server", "tasks/s"), rows, [requirement])


def _rate(way: str, endpoint: str, robots: int, processes: int) -> tuple[float, int]:
    """Tasks per second of all robots together, and the number of wrong answers."""
    shares = [robots // processes + (n < robots % processes) for n in range(processes)]
    each = TASKS // processes
    with contextlib.ExitStack() as stack:
        command = [sys.executable, "-m", "benchmarks.robots", way, endpoint]
        in_flight = IN_FLIGHT // processes
        started = [
            stack.enter_context(running([*command, str(share), str(each), str(in_flight)]))
            for share in shares
        ]
        for process in started:
            assert process.stdout is not None
            process.stdout.readline()
        for process in started:
            assert process.stdin is not None
            process.stdin.write("\n")
            process.stdin.flush()
        said = [process.stdout.readline().split() for process in started if process.stdout]
    return each * processes / max(float(seconds) for seconds, _ in said), sum(int(wrong) for _, wrong in said)


def _loaded() -> Table:
    """Plans at random instants, at LOAD of the capacity of one worker, compared to an ideal queue."""
    grid, kind = read_map(MAP), kind_of(planner.plan_path)
    goals = [
        (Pose(*map(float, start)), Point(*map(float, goal)))
        for start, goal in (
            grid.metres(pair) for pair in free_pairs(grid, PLANS, seed=1, radius_m=planner.RADIUS_M)
        )
    ]
    tasks = [Task(kind, kind.bind((grid, None, *ends), {}), 0.0) for ends in goals]
    rows, ratios, loads = list[list[str]](), dict[str, list[float]](), list[float]()
    for executor in EXECUTORS:
        runs = [_plans(executor, tasks) for _ in range(ROUNDS)]
        ratios[executor] = [real[-1] / ideal[-1] for real, ideal, _ in runs]
        loads += [load for *_, load in runs]
        for n, name in enumerate((executor, f"{executor}: ideal queue, in order of arrival")):
            middle = np.median([one[n] for one in runs], axis=0)
            rows.append([name, *(f"{each * 1e3:.1f}" for each in middle)])
    bars = [
        Requirement(f"{executor}: P99, relative to the ideal queue", statistics.median(found), 1.4)
        for executor, found in ratios.items()
    ]
    title = f"{PLANS} plans at {statistics.median(loads):.0%} load, ms, median of {ROUNDS} runs"
    return Table(title, ("executor", *(f"P{percent}" for percent in PERCENT)), rows, bars)


def _plans(executor: str, tasks: Sequence[Task]) -> tuple[Times, Times, float]:
    """The PERCENT percentiles of the response times, those of an ideal queue, and the load of the server."""
    kind = tasks[0].kind
    with (
        cloud_server(
            "offboard.common.planning.planner", CLOUD_WORKERS="1", CLOUD_EXECUTOR=executor
        ) as server,
        contextlib.closing(CloudRunner(server.endpoint)) as runner,
    ):
        while runner.unavailable(kind):
            time.sleep(0.01)
        alone = [runner.submit(task, BUDGET_S).result() for task in tasks[:WARM]]
        mean_s = statistics.fmean(_ran_s(one) for one in alone) / LOAD
        sent, done = _run_at_random(runner, tasks, mean_s)
    real, ideal = np.array([one.seconds for one in done]), _ideal(sent, [_ran_s(one) for one in done])
    load = sum(_ran_s(one) for one in done) / (sent[-1] - sent[0])
    return np.percentile(real, PERCENT), np.percentile(ideal, PERCENT), load


def _run_at_random(
    runner: CloudRunner, tasks: Sequence[Task], mean_s: float
) -> tuple[list[float], list[Execution]]:
    """Start tasks at random instants, `mean_s` apart on average; returns these instants and the results."""
    gaps = random.Random(1)
    due, answers, sent = time.perf_counter(), list[Future[Execution]](), list[float]()
    for task in tasks:
        due += gaps.expovariate(1 / mean_s)
        time.sleep(max(0.0, due - time.perf_counter()))
        sent.append(time.perf_counter())
        answers.append(runner.submit(task, BUDGET_S))
    return sent, [answer.result() for answer in answers]


def _ran_s(one: Execution) -> float:
    if one.run_s is None:
        raise RuntimeError(f"a plan failed: {one.error}")
    return one.run_s


def _ideal(sent: Sequence[float], service: Sequence[float]) -> Times:
    """The response times of a queue without any cost but the service times."""
    free_s, found = 0.0, []
    for at_s, took_s in zip(sent, service, strict=True):
        free_s = max(free_s, at_s) + took_s
        found.append(free_s - at_s)
    return np.array(found)
