"""The servers of a simulated fleet: queues, heartbeats, what they were used for, and the oracle.

All servers are equal. They live in one process and are moved on in windows of time.
"""

import heapq
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from offboard.loadgen.fleet.fleet_messages import (
    ASK,
    BEAT,
    BEAT_REPLY,
    CANCEL,
    REPLY,
    ToRobot,
    ToServer,
)
from offboard.loadgen.fleet.fleet_settings import FleetSize

SAMPLE_S = 0.25  # between two samples of the load of every server
ENDS = -1  # the sort of the events of a server itself, which come before messages of the same instant
QUEUE_MAX = 100_000  # requests that wait at one server; a simulation with more has gone wrong


@dataclass(eq=False, slots=True)
class Run:
    """A request at a server. `life` changes with its place in the queue: earlier events are then void."""

    robot: int
    number: int
    cpu_s: float
    added_s: float
    begins_s: float = 0.0
    life: int = 0


class Server:
    """Runs requests in the order of their arrival, `workers` at a time, each on a CPU of its own."""

    def __init__(self, workers: int) -> None:
        self.busy_s = 0.0  # what its runs took so far
        self.runs: dict[tuple[int, int], Run] = {}  # that wait or run, in order
        self._free = [0.0] * workers  # when each worker will be free
        self._waiting: deque[Run] = deque()

    def begins_s(self, now_s: float) -> float:
        """When a request that arrives now would begin."""
        return max(now_s, self._free[0])

    def queue(self, now_s: float) -> int:
        """How many requests wait."""
        while self._waiting and self._waiting[0].begins_s <= now_s:
            self._waiting.popleft()
        return len(self._waiting)

    def add(self, run: Run, now_s: float) -> float:
        """Put a request into the queue, and return when it will end."""
        assert len(self._waiting) < QUEUE_MAX
        self.runs[run.robot, run.number] = run
        self._waiting.append(run)
        return self._place(run, now_s)

    def end(self, run: Run) -> None:
        del self.runs[run.robot, run.number]
        self.busy_s += run.cpu_s

    def cancel(self, robot: int, number: int, now_s: float) -> list[tuple[float, Run]]:
        """Drop a request that waits; returns the new ends of those behind it. A run goes on to its end."""
        run = self.runs.get((robot, number))
        if run is None or run.begins_s <= now_s:
            return []
        del self.runs[robot, number]
        run.life += 1
        begun = [one for one in self.runs.values() if one.begins_s <= now_s]
        busy = [one.begins_s + one.cpu_s for one in begun]
        self._free = sorted(busy + [now_s] * (len(self._free) - len(busy)))
        self._waiting = deque(one for one in self.runs.values() if one.begins_s > now_s)
        for one in self._waiting:
            one.life += 1
        return [(self._place(one, now_s), one) for one in self._waiting]

    def _place(self, run: Run, now_s: float) -> float:
        run.begins_s = self.begins_s(now_s)
        heapq.heapreplace(self._free, run.begins_s + run.cpu_s)
        return run.begins_s + run.cpu_s


class Servers:
    """All servers, and the oracle, which knows them as they are.

    - `delay_s`: of the link, in each direction.
    - `oracle_s`: what each task of each robot would have taken on the best site that the robot uses.
    """

    def __init__(self, size: FleetSize, tasks: int, delay_s: float) -> None:
        self.oracle_s: NDArray[np.float64] = np.full((size.robots, tasks), np.nan)
        self.samples: list[NDArray[np.int32]] = []  # requests at each server, every SAMPLE_S
        self._servers = [Server(size.workers) for _ in range(size.servers)]
        self._delay_s = delay_s
        self._events: list[tuple[ToServer, int, Run | None]] = []  # with a life

    @property
    def busy_s(self) -> NDArray[np.float64]:
        return np.array([server.busy_s for server in self._servers])

    def step(self, messages: Iterable[ToServer], until_s: float) -> list[ToRobot]:
        """Handle everything that happens before `until_s`; returns what the servers sent."""
        for message in messages:
            heapq.heappush(self._events, (message, 0, None))
        sent: list[ToRobot] = []
        while self._events and self._events[0][0].arrives_s < until_s:
            message, life, run = heapq.heappop(self._events)
            if run is None:
                sent.extend(self._receive(message))
            elif run.life == life:
                sent.append(self._end(message, run))
        while len(self.samples) * SAMPLE_S < until_s:
            self.samples.append(np.array([len(server.runs) for server in self._servers], np.int32))
        return sent

    def _receive(self, message: ToServer) -> list[ToRobot]:
        now_s, sort, robot, index, number, cpu_s, limit_s, ways = message
        if sort == ASK:
            begins_s = min(self._servers[one].begins_s(now_s) for one in ways)
            self.oracle_s[robot, number] = min(limit_s, begins_s - now_s + cpu_s + 2 * self._delay_s)
            return []
        server = self._servers[index]
        if sort == BEAT:
            queue = server.queue(now_s)
            return [ToRobot(now_s + self._delay_s, robot, index, BEAT_REPLY, number=number, queue=queue)]
        if sort == CANCEL:
            for end_s, run in server.cancel(robot, number, now_s):
                self._plan_end(end_s, index, run)
        elif server.begins_s(now_s) < limit_s:
            run = Run(robot, number, cpu_s, now_s)
            self._plan_end(server.add(run, now_s), index, run)
        return []

    def _plan_end(self, end_s: float, index: int, run: Run) -> None:
        heapq.heappush(
            self._events, (ToServer(end_s, ENDS, run.robot, index, number=run.number), run.life, run)
        )

    def _end(self, message: ToServer, run: Run) -> ToRobot:
        now_s, server = message.arrives_s, self._servers[message.server]
        server.end(run)
        return ToRobot(
            now_s + self._delay_s,
            run.robot,
            message.server,
            REPLY,
            number=run.number,
            queue=server.queue(now_s),
            queue_s=run.begins_s - run.added_s,
            run_s=run.cpu_s,
        )
