"""What one server takes: empty tasks from many robots, and plans that come as fast as it can just bear."""

import contextlib
import random
import statistics
import sys
import time
from collections.abc import Sequence
from concurrent.futures import Future
from pathlib import Path

import numpy as np

from benchmarks.measure import Bar, Table
from benchmarks.servers import cloud_server, running, serve
from offboard.common.planning import planner
from offboard.common.planning.map_files import read_map
from offboard.common.planning.maps import free_pairs
from offboard.common.planning.planner import Point, Pose
from offboard.common.tasks import Task, kind_of
from offboard.robot_client.sites.cloud import CloudRunner
from offboard.robot_client.sites.runner import Execution

ROBOTS = (1, 10, 100, 1_000)
PROCESSES, IN_FLIGHT = 4, 32  # of the robots; tasks of all of them
CLIENTS, CLIENT_PROCESSES = 8, 2
TASKS = 6_000
ROUNDS = 5
PLANS, LOAD, WARM = 1_000, 0.8, 50
BUDGET_S = 60.0
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
    bars = [
        Bar(f"least over most from {ROBOTS[1]} robots on", min(full) / max(full), 0.8, at_least=True),
        Bar(f"wrong answers to up to {ROBOTS[-1]} robots", wrong, 0),
    ]
    return Table("Empty tasks a second", ("robots", "offboard", "raw ROUTER echo", "share"), rows, bars)


def _clients(ours: str, echo: str) -> Table:
    """Our own clients against bare sockets: what both ends cost."""
    found: list[tuple[float, float]] = []
    for _ in range(ROUNDS):
        rate, wrong = _rate("client", ours, CLIENTS, CLIENT_PROCESSES)
        if wrong:
            raise RuntimeError(f"{wrong} of {TASKS} answers are wrong")
        found.append((rate, _rate("raw", echo, CLIENTS, CLIENT_PROCESSES)[0]))
    rate, limit = (statistics.median(each) for each in zip(*found, strict=True))
    rows = [["offboard", f"{rate:.0f}"], ["raw ROUTER echo", f"{limit:.0f}"]]
    bar = Bar("offboard over raw echo", rate / limit, 0.25, at_least=True)
    return Table(f"Empty tasks a second, pipelined from {CLIENTS} clients", ("way", "tasks/s"), rows, [bar])


def _rate(way: str, endpoint: str, robots: int, processes: int) -> tuple[float, int]:
    """Tasks a second of all together, and wrong answers."""
    shares = [robots // processes + (n < robots % processes) for n in range(processes)]
    each = TASKS // processes
    with contextlib.ExitStack() as stack:
        started = [
            stack.enter_context(
                running(
                    [
                        sys.executable,
                        "-m",
                        "benchmarks.robots",
                        way,
                        endpoint,
                        str(share),
                        str(each),
                        str(IN_FLIGHT // processes),
                    ]
                )
            )
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
    """Plans at random instants, LOAD of what one worker does; beside a queue without any other cost."""
    grid, kind = read_map(MAP), kind_of(planner.plan_path)
    goals = [
        (Pose(*map(float, start)), Point(*map(float, goal)))
        for start, goal in (
            grid.metres(pair) for pair in free_pairs(grid, PLANS, seed=1, radius_m=planner.RADIUS_M)
        )
    ]
    tasks = [Task(kind, kind.bind((grid, None, *ends), {}), 0.0) for ends in goals]
    with (
        cloud_server("offboard.common.planning.planner", CLOUD_WORKERS="1") as server,
        contextlib.closing(CloudRunner(server.endpoint)) as runner,
    ):
        while runner.unavailable(kind):
            time.sleep(0.01)
        alone = [runner.submit(task, BUDGET_S).result() for task in tasks[:WARM]]
        gaps = random.Random(1)
        mean_s = statistics.fmean(_ran_s(one) for one in alone) / LOAD
        due, answers, sent = time.perf_counter(), list[Future[Execution]](), list[float]()
        for task in tasks:
            due += gaps.expovariate(1 / mean_s)
            time.sleep(max(0.0, due - time.perf_counter()))
            sent.append(time.perf_counter())
            answers.append(runner.submit(task, BUDGET_S))
        done = [answer.result() for answer in answers]
    real, ideal = np.array([one.seconds for one in done]), _ideal(sent, [_ran_s(one) for one in done])
    rows = [
        [name, *(f"{np.percentile(seconds, percent) * 1e3:.1f}" for percent in (50, 95, 99))]
        for name, seconds in (("offboard", real), ("first come, first served, at no cost", ideal))
    ]
    load = sum(_ran_s(one) for one in done) / (sent[-1] - sent[0])
    bar = Bar(
        "P99 over that of the ideal queue", float(np.percentile(real, 99) / np.percentile(ideal, 99)), 1.3
    )
    return Table(f"{PLANS} plans at {load:.0%} load, ms", ("queue", "P50", "P95", "P99"), rows, [bar])


def _ran_s(one: Execution) -> float:
    if one.run_s is None:
        raise RuntimeError(f"a plan failed: {one.error}")
    return one.run_s


def _ideal(sent: Sequence[float], service: Sequence[float]) -> "np.ndarray[tuple[int], np.dtype[np.float64]]":
    free_s, found = 0.0, []
    for at_s, took_s in zip(sent, service, strict=True):
        free_s = max(free_s, at_s) + took_s
        found.append(free_s - at_s)
    return np.array(found)
