"""A simulated computer: its CPU quota, work that waits for it, busy programs that share it, and its load."""

import heapq
import math
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial

from offboard.common.load import FREE_MIN
from offboard.testing.virtual_clock import VirtualClock

QUEUE_MAX = 100_000  # work that waits; a simulation with more has gone wrong


@dataclass(eq=False, slots=True)
class Run:
    """Work that waits or runs: the CPU seconds left, its owner, and the function to call when it ends.

    It does not begin at or after `until_s`. `begun_s` is infinite until it begins.
    """

    left_s: float
    owner: str
    ended: Callable[["Run"], object]
    until_s: float
    added_s: float
    begun_s: float = math.inf


class SimulatedCpu:
    """Runs work in order of arrival, `workers` at a time, on a quota of `cpus` CPUs.

    Other busy programs (`hogs`) share the quota. Each running piece of work and each hog gets the same part,
    at most one CPU.
    """

    def __init__(self, clock: VirtualClock, cpus: float, workers: int = 1) -> None:
        self.own_s = self.others_s = 0.0  # CPU seconds used by work and by hogs, up to the last `settle`
        self.cpus = cpus
        self._clock = clock
        self._workers = workers
        self._hogs = 0
        self._paused = False
        self._running: list[Run] = []
        self._queue: deque[Run] = deque()
        self._settled_s = clock.now_s()
        self._plan_number = 0  # an event that belongs to an earlier plan does not happen

    @property
    def waiting(self) -> int:
        return len(self._queue)

    @property
    def count(self) -> int:
        """How much work waits or runs."""
        return len(self._queue) + len(self._running)

    def add(
        self, cpu_s: float, ended: Callable[[Run], object], *, owner: str = "", until_s: float = math.inf
    ) -> Run:
        assert len(self._queue) < QUEUE_MAX
        run = Run(cpu_s, owner, ended, until_s=until_s, added_s=self._clock.now_s())
        self.settle()
        self._queue.append(run)
        self._plan()
        return run

    def drop(self, run: Run) -> bool:
        """Remove work that waits, and return whether it did wait; work that runs continues."""
        if run not in self._queue:
            return False
        self._queue.remove(run)
        return True

    def stop(self, run: Run) -> None:
        """Remove work, whether it waits or runs."""
        if not self.drop(run):
            self.settle()
            self._running.remove(run)
            self._plan()

    def clear(self) -> None:
        """Lose all work and all hogs."""
        self.settle()
        self._running.clear()
        self._queue.clear()
        self._hogs, self._paused = 0, False
        self._plan()

    def change(
        self, *, cpus: float | None = None, hogs: int | None = None, paused: bool | None = None
    ) -> None:
        self.settle()
        self.cpus = self.cpus if cpus is None else cpus
        self._hogs = self._hogs if hogs is None else hogs
        self._paused = self._paused if paused is None else paused
        self._plan()

    def share(self, busy: int) -> float:
        """The CPUs that each of `busy` programs gets, next to the hogs."""
        return 0.0 if self._paused else min(1.0, self.cpus / (busy + self._hogs))

    @property
    def share_of_one_more(self) -> float:
        return self.share(len(self._running) + 1)

    def begins_s(self, arrives_s: float, coming: Iterable[tuple[float, float]], *, without: str) -> float:
        """When work that arrives at `arrives_s` would begin, if no other work came than `coming`.

        `coming` holds arrival times with CPU seconds. Work here that belongs to `without` is left out.
        """
        speed = self.share(self._workers)
        if not speed:
            return math.inf
        self.settle()
        here = [run.left_s for run in (*self._running, *self._queue) if run.owner != without]
        free = [self._clock.now_s()] * self._workers
        for at_s, cpu_s in [*((free[0], left_s) for left_s in here), *sorted(coming)]:
            if at_s <= arrives_s:
                heapq.heapreplace(free, max(at_s, free[0]) + cpu_s / speed)
        return max(arrives_s, free[0])

    def settle(self) -> None:
        """Count the CPU seconds that were used up to now."""
        now_s = self._clock.now_s()
        since_s, self._settled_s = now_s - self._settled_s, now_s
        if since_s <= 0:
            return
        speed = self.share(len(self._running)) if self._running else 0.0
        for run in self._running:
            run.left_s -= since_s * speed
        used = speed * len(self._running)
        self.own_s += since_s * used
        self.others_s += since_s * min(self._hogs, self.cpus - used)

    def _plan(self) -> None:
        """Begin the work that can begin, and plan the end of the run that ends first."""
        self._plan_number += 1
        now_s = self._clock.now_s()
        while self._queue and not self._paused and len(self._running) < self._workers:
            run = self._queue.popleft()
            if now_s < run.until_s:
                run.begun_s = now_s
                self._running.append(run)
        if self._running and not self._paused:
            first = min(self._running, key=lambda run: run.left_s)
            seconds = max(0.0, first.left_s) / self.share(len(self._running))
            self._clock.after(seconds, partial(self._end, first, self._plan_number))

    def _end(self, run: Run, plan_number: int) -> None:
        if plan_number == self._plan_number:
            self.settle()
            self._running.remove(run)
            self._plan()
            run.ended(run)


class SimulatedLoad:
    """What `offboard.common.load` would measure: the CPU quota, and the share that other programs take.

    `latest` is that share of the CPU time that our own work leaves; `capacity` is the quota, at most 1 CPU.
    """

    def __init__(self, clock: VirtualClock, cpu: SimulatedCpu) -> None:
        self._clock = clock
        self._cpu = cpu
        self._read_at_s = self._own_s = self._others_s = self.latest = 0.0
        self.capacity = min(1.0, cpu.cpus)

    def share(self, every_s: float) -> float:
        """The share of other programs, measured again if the last measurement is `every_s` old."""
        since_s = self._clock.now_s() - self._read_at_s
        if since_s >= every_s:
            self._cpu.settle()
            self.capacity = min(1.0, self._cpu.cpus)
            own_s, others_s = self._cpu.own_s, self._cpu.others_s
            took_s, left_s = others_s - self._others_s, self._cpu.cpus * since_s - (own_s - self._own_s)
            self._own_s, self._others_s, self._read_at_s = own_s, others_s, self._clock.now_s()
            if left_s >= FREE_MIN * self._cpu.cpus * since_s:
                self.latest = min(1.0, max(0.0, took_s / left_s))
        return self.latest
