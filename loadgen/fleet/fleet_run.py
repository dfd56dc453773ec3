"""One simulated fleet from its start to its last answer: windows of time, robots in several processes.

A window is as long as the delay of the link. What is sent in one window arrives after it, so robots and
servers need to exchange messages only between windows, and the number of processes changes nothing.
"""

import contextlib
import gc
import logging
import math
import multiprocessing
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.common.errors import OffloadError
from offboard.loadgen.fleet.fleet_robot import Common, Done, FleetNoise, FleetRobot
from offboard.loadgen.fleet.fleet_servers import Servers, ToRobot, ToServer, server_of
from offboard.loadgen.fleet.fleet_settings import FleetConfig, FleetSize
from offboard.loadgen.progress import Progress
from offboard.loadgen.scenario.scenario import Workload
from offboard.loadgen.simulation.child_processes import end_quietly, starting
from offboard.loadgen.simulation.model.task_costs import RobotTasks, find_tasks
from offboard.loadgen.simulation.model.true_costs import TrueCosts
from offboard.testing.virtual_clock import VirtualClock

TASK = "offboard.loadgen.scenario.hash_tasks:hash_rounds"
TASKS = 1000  # different tasks; each robot starts at another one and repeats them
SPREAD = 0.5  # sizes are within this share of their mean
LIMIT_S = 24 * 3600.0  # virtual time after which a fleet that still works has hung
FEW_ROBOTS = 50  # so few robots are simulated by one process
ANSWER_S = 600.0  # longest wait for a process; a window takes milliseconds
END_S = 5.0


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
    shards: list[Shard | ShardProcess] = []
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
    shards: Sequence["Shard | ShardProcess"],
    servers: Servers,
    tasks: int,
    window_s: float,
    *,
    shown: Progress,
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


@dataclass(frozen=True, slots=True)
class ShardSettings:
    """What the robots of a shard need: the tasks of all, their numbers, and the number of servers."""

    config: FleetConfig
    tasks: RobotTasks
    robots: range
    servers: int
    period_s: float


class Shard:
    """The robots of one process, moved on in windows: `begin` starts a window, `end` waits for it."""

    def __init__(self, settings: ShardSettings) -> None:
        logging.disable(logging.WARNING)
        # Millions of objects that live on are looked through again and again otherwise; none are in circles.
        gc.disable()
        self._clock = VirtualClock()
        self._sent: list[ToServer] = []
        self._answered = 0
        common = Common(
            settings.config,
            TrueCosts(settings.tasks, FleetNoise(settings.config.seed)),
            listed=[server_of(number) for number in range(settings.servers)],
            period_s=settings.period_s,
        )
        self._robots = {
            number: FleetRobot(number, common, self._clock, post=self._post, answered=self._count)
            for number in settings.robots
        }
        for robot in self._robots.values():
            robot.begin()

    def begin(self, messages: Sequence[ToRobot], until_s: float) -> None:
        for message in messages:
            self._clock.at(message.arrives_s, partial(self._robots[message.robot].receive, message))
        while self._clock.step(until_s):
            pass

    def end(self) -> tuple[list[ToServer], int]:
        """What the robots sent, and how many tasks they have done in the window."""
        sent, answered = self._sent, self._answered
        self._sent, self._answered = [], 0
        return sent, answered

    def done(self) -> dict[int, list[Done]]:
        """The tasks of each robot."""
        return {number: robot.done for number, robot in self._robots.items()}

    def close(self) -> None:
        logging.disable(logging.NOTSET)
        gc.enable()

    def _count(self) -> None:
        self._answered += 1

    def _post(self, message: ToServer) -> None:
        self._sent.append(message)


class ShardProcess:
    """A shard in a process of its own."""

    def __init__(self, settings: ShardSettings) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, settings), daemon=True)
        with starting():
            self._process.start()
        theirs.close()

    def begin(self, messages: Sequence[ToRobot], until_s: float) -> None:
        with contextlib.suppress(OSError):  # the process has ended: `end` says so
            self._pipe.send((messages, until_s))

    def end(self) -> tuple[list[ToServer], int]:
        found: tuple[list[ToServer], int] = self._answer()
        return found

    def done(self) -> dict[int, list[Done]]:
        self._pipe.send(None)
        found: dict[int, list[Done]] = self._answer()
        return found

    def close(self) -> None:
        self._pipe.close()
        self._process.join(END_S)
        if self._process.is_alive():
            self._process.kill()

    def _answer(self) -> Any:
        with contextlib.suppress(EOFError, OSError):
            if self._pipe.poll(ANSWER_S):
                return self._pipe.recv()
        raise OffloadError(f"a process of the fleet ended, or took over {ANSWER_S:g} s for a window")


def _serve(pipe: Connection, settings: ShardSettings) -> None:
    """Move a shard on until the other side closes the pipe."""
    end_quietly()
    threading.current_thread().name = "fleet"
    shard = Shard(settings)
    while True:
        try:
            wanted = pipe.recv()
        except EOFError:
            return
        if wanted is None:
            pipe.send(shard.done())
            continue
        shard.begin(*wanted)
        pipe.send(shard.end())
