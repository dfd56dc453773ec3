"""One simulated fleet from its start to its last answer: windows of time, robots in several processes.

A window is as long as the delay of the link. What is sent in one window arrives after it, so robots and
servers need to exchange messages only between windows, and the number of processes changes nothing.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from offboard.common.errors import OffloadError
from offboard.loadgen.fleet.fleet_messages import ToRobot, ToServer
from offboard.loadgen.fleet.fleet_robot import Done
from offboard.loadgen.fleet.fleet_servers import Servers
from offboard.loadgen.fleet.fleet_settings import FleetConfig, FleetSize
from offboard.loadgen.fleet.fleet_shard import Robots, Shard, ShardProcess, ShardSettings
from offboard.loadgen.progress import Progress
from offboard.loadgen.scenario.scenario import Workload
from offboard.loadgen.simulation.model.simulated_tasks import RobotTasks, find_tasks

TASK = "offboard.loadgen.scenario.hash_tasks:hash_rounds"
TASKS = 1000  # different tasks; each robot starts at another one and repeats them
SPREAD = 0.5  # sizes are within this share of their mean
LIMIT_S = 24 * 3600.0  # virtual time after which a fleet that still works has hung
FEW_ROBOTS = 50  # so few robots are simulated by one process


@dataclass(frozen=True, slots=True)
class Fleet:
    """A fleet that has answered all its tasks.

    - `done`: the tasks of each robot. `oracle_s`: what they would have taken on the best site that it used.
    - `samples`: the requests at each server over time. `busy_s`: how long the workers of each server ran.
    """

    size: FleetSize
    done: Sequence[Sequence[Done]]
    oracle_s: NDArray[np.float64]
    samples: NDArray[np.int32]
    busy_s: NDArray[np.float64]


def make_tasks(config: FleetConfig) -> RobotTasks:
    """The tasks that the robots repeat."""
    low, high = (1 - SPREAD) * config.rounds, (1 + SPREAD) * config.rounds
    workload = Workload(task=TASK, sizes=(f"uniform:{low:g}:{high:g}",), tasks=TASKS)
    return find_tasks(workload, config.seed, TASKS)


def run_fleet(
    config: FleetConfig, size: FleetSize, tasks: RobotTasks, *, jobs: int, shown: Progress
) -> Fleet:
    """Simulate one fleet. `shown` gets the answered tasks."""
    delay_s = config.delay_ms / 1e3
    period_s = size.period_s(tasks.cost.cpu_s(config.rounds), config.load)
    servers = Servers(size, config.tasks, delay_s)
    jobs = 1 if size.robots <= FEW_ROBOTS else jobs
    shards: list[Robots] = []
    try:
        for job in range(jobs):
            mine = range(job, size.robots, jobs)
            settings = ShardSettings(config, tasks, mine, size.servers, period_s=period_s)
            shards.append(Shard(settings) if jobs == 1 else ShardProcess(settings))
        _play(shards, servers, size.robots * config.tasks, delay_s, shown=shown)
        found = {number: done for shard in shards for number, done in shard.done().items()}
    finally:
        for shard in shards:
            shard.close()
    return Fleet(
        size,
        done=[found[number] for number in range(size.robots)],
        oracle_s=servers.oracle_s,
        samples=np.array(servers.samples),
        busy_s=servers.busy_s,
    )


def _play(
    shards: Sequence[Robots], servers: Servers, tasks: int, window_s: float, *, shown: Progress
) -> None:
    """Move robots and servers on, window by window, until all tasks have their answers."""
    answered, to_servers = 0, list[ToServer]()
    to_robots: list[list[ToRobot]] = [[] for _ in shards]
    for window in range(1, math.ceil(LIMIT_S / window_s)):
        until_s = window * window_s
        for shard, messages in zip(shards, to_robots, strict=True):
            shard.begin(messages, until_s)
        to_robots = [[] for _ in shards]
        for message in servers.step(to_servers, until_s):
            to_robots[message.robot % len(shards)].append(message)
        to_servers = []
        for shard in shards:
            sent, count = shard.end()
            to_servers += sent
            answered += count
        shown.to(answered)
        if answered == tasks:
            servers.step(to_servers, until_s + 2 * window_s)
            return
    raise OffloadError(f"the fleet has not answered its tasks after {LIMIT_S:g} s of virtual time")
