"""A simulated CPU quota: work in line, hogs that share it, and how long what is new would wait."""

import heapq
import math
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial

from offboard.loadgen.simulation.model.clock import VirtualClock

LINE_MAX = 100_000  # in line; a simulation that has more has gone wrong


@dataclass(eq=False, slots=True)
class Run:
    """Work in line or running: CPU seconds left, who it is for, and what is done when it ends.

    It is not begun from `until_s` on.
    """

    left_s: float
    owner: str
    ended: Callable[["Run"], object]
    until_s: float
    added_s: float
    begun_s: float = math.inf


class Processor:
    """Runs work first come, first served, `workers` at a time, on `cpus` CPUs that busy programs share.

    Each of those and each of `hogs` gets the same part of the quota, a whole CPU at most.
    """

    def __init__(self, clock: VirtualClock, cpus: float, workers: int = 1) -> None:
        self.own_s = self.others_s = 0.0  # CPU seconds that work and hogs have used, as of the last change
        self.cpus = cpus
        self._clock = clock
        self._workers = workers
        self._hogs = 0
        self._paused = False
        self._running: list[Run] = []
        self._line: deque[Run] = deque()
        self._settled_s = clock.now_s()
        self._turn = 0  # what was planned in an earlier one does not happen

    @property
    def waiting(self) -> int:
        return len(self._line)

    def add(
        self, cpu_s: float, ended: Callable[[Run], object], *, owner: str = "", until_s: float = math.inf
    ) -> Run:
        assert len(self._line) < LINE_MAX
        run = Run(cpu_s, owner, ended, until_s, self._clock.now_s())
        self.settle()
        self._line.append(run)
        self._plan()
        return run

    def drop(self, run: Run) -> bool:
        """Take it out of the line; False where it has begun, and goes on."""
        if run not in self._line:
            return False
        self._line.remove(run)
        return True

    def stop(self, run: Run) -> None:
        """Give it up, whether or not it has begun."""
        if not self.drop(run):
            self.settle()
            self._running.remove(run)
            self._plan()

    def clear(self) -> None:
        """All of it is lost, hogs too."""
        self.settle()
        self._running.clear()
        self._line.clear()
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
        """CPUs that each of so many busy programs gets beside the hogs."""
        return 0.0 if self._paused else min(1.0, self.cpus / (busy + self._hogs))

    @property
    def share_of_one_more(self) -> float:
        """CPUs that whatever else runs here gets now."""
        return self.share(len(self._running) + 1)

    def begins_s(self, arrives_s: float, coming: Iterable[tuple[float, float]], *, without: str) -> float:
        """When work that arrives then would begin, if no more came than what is here and `coming`.

        `coming` are arrivals and their CPU seconds; what `without` has here is as if it were not.
        """
        speed = self.share(self._workers)
        if not speed:
            return math.inf
        self.settle()
        here = [run.left_s for run in (*self._running, *self._line) if run.owner != without]
        free = [self._clock.now_s()] * self._workers
        for at_s, cpu_s in [*((free[0], left_s) for left_s in here), *sorted(coming)]:
            if at_s <= arrives_s:
                heapq.heapreplace(free, max(at_s, free[0]) + cpu_s / speed)
        return max(arrives_s, free[0])

    def settle(self) -> None:
        """Bring what was used up to now."""
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
        """Begin what can, and end next what ends first."""
        self._turn += 1
        now_s = self._clock.now_s()
        while self._line and not self._paused and len(self._running) < self._workers:
            run = self._line.popleft()
            if now_s < run.until_s:
                run.begun_s = now_s
                self._running.append(run)
        if self._running and not self._paused:
            first = min(self._running, key=lambda run: run.left_s)
            seconds = max(0.0, first.left_s) / self.share(len(self._running))
            self._clock.after(seconds, partial(self._end, first, self._turn))

    def _end(self, run: Run, turn: int) -> None:
        if turn == self._turn:
            self.settle()
            self._running.remove(run)
            self._plan()
            run.ended(run)
