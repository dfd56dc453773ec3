"""The queue of accepted requests: one line per robot, without clocks; `scheduler` decides who enters it."""

import math
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass

from offboard.common.wire.blobs import StoredBlob
from offboard.common.wire.messages import Request, byte_count

AHEAD_S = (
    0.5  # of worker time, that a robot in a hurry may have had more: over a minute, below 5 % of its share
)
USUAL_RATE = 0.1  # share of each new run time in the usual run time
ROBOTS_MAX = 1024  # robots whose worker time is remembered; beyond it those without requests are forgotten


@dataclass(slots=True, eq=False)
class Work:
    """An accepted request with its blobs. Times are on the monotonic clock of the server."""

    peer: bytes
    request: Request
    blobs: dict[bytes, StoredBlob]
    arrived: float
    robot: bytes  # its public key; the connection if there are no keys
    queue_s: float = 0.0
    wanted: bool = True
    charged_s: float = 0.0  # worker time that its robot was charged at the start
    group: tuple[str, str] | None = None  # what it may run together with; None: it runs alone
    useless_s: float = math.inf  # when nobody needs the answer any more
    number: int = 0  # of its run, in `Gathering`
    more: "tuple[Work, ...]" = ()  # what runs together with it

    def expired(self, now: float) -> bool:
        return now - self.arrived >= self.request.budget_s


class FairQueue:
    """At most `queue_max` requests. It is fair between robots; each robot is served first come, first served.

    The next request is that of the robot that has had the least worker time. A robot gets no credit for a
    pause: when it returns, it starts with the worker time of the robot that was chosen last. While a request
    runs, its robot is charged the usual run time (start-time fair queueing, Goyal, Vin and Cheng 1996). If
    the queue is full, the longest line loses its newest request.

    Of the robots that are at most AHEAD_S ahead, or a usual run if that is longer, the one whose answer
    becomes useless first is served first. So nobody gains by always being in a hurry.
    """

    def __init__(self, queue_max: int) -> None:
        self.queue_max = queue_max
        self._lines: dict[bytes, deque[Work]] = {}
        self._running: dict[bytes, int] = {}
        self._had_s: dict[bytes, float] = {}  # worker time of each robot
        self._least_s = 0.0  # worker time of the robot chosen last; a returning robot starts with it
        self.usual_s = 0.0
        self._count = 0
        self._hurried = False  # whether any request has said when its answer is useless
        self._held = _HeldBytes()
        self.groups: Counter[tuple[str, str]] = Counter()  # waiting requests that may run together

    @property
    def robots(self) -> int:
        """How many robots have waiting requests."""
        return len(self._lines)

    def bytes_with(self, work: Work) -> int:
        """Memory of all waiting and running requests, in bytes, if this one is added."""
        return self._held.byte_count + self._held.more(work)

    def closed_to(self, robot: bytes) -> bool:
        """True if the queue is full and no other robot's line would be longer than this robot's."""
        return self._count >= self.queue_max and len(self._longest()) <= len(self._lines.get(robot, ())) + 1

    def add(self, work: Work) -> Work | None:
        """Add a request, unless the queue is closed to its robot; returns the request that had to leave."""
        evicted = None
        if self._count >= self.queue_max:
            line = self._longest()
            evicted = line.pop()
            self._held.drop(evicted)
            self._count -= 1
            if evicted.group is not None:
                self._ungroup(evicted.group)
        self._held.add(work)
        least_s = self._least_s
        if work.useless_s < math.inf:
            self._hurried = True
        elif self._hurried and work.robot in self._had_s:  # those that wait may be ahead of it
            least_s -= max(AHEAD_S, self.usual_s)
        self._had_s[work.robot] = max(self._had_s.get(work.robot, 0.0), least_s)
        self._lines.setdefault(work.robot, deque()).append(work)
        self._count += 1
        if work.group is not None:
            self.groups[work.group] += 1
        return evicted

    def put_back(self, work: Work) -> None:
        """A request from `next` waits again, alone, as the first one of its robot. It is not charged."""
        self.done(work, 0.0)
        work.group = None
        self._held.add(work)
        self._had_s.setdefault(work.robot, self._least_s)
        self._lines.setdefault(work.robot, deque()).appendleft(work)
        self._count += 1

    def _ungroup(self, group: tuple[str, str]) -> None:
        """A request of this group waits no more."""
        self.groups[group] -= 1
        if not self.groups[group]:
            del self.groups[group]

    def _longest(self) -> deque[Work]:
        return max(self._lines.values(), key=len)

    def next(self, fits: Callable[[Work], bool] | None = None) -> Work | None:
        """The next request. Its robot is charged the usual run time, until `done` reports the true one.

        `fits`: only requests for which it is true; None: all.
        """
        robots: Collection[bytes] = self._lines
        if fits is not None:
            robots = [robot for robot, line in self._lines.items() if fits(line[0])]
        if not robots:
            return None
        robot = next(iter(robots))
        self._least_s = self._had_s[robot]
        if len(robots) > 1:
            robot, self._least_s = self._first_of(robots)
        if fits is not None:  # the others have not had their turn
            self._least_s = min(map(self._had_s.__getitem__, self._lines))
        line = self._lines[robot]
        work = line.popleft()
        if not line:
            del self._lines[robot]
        self._count -= 1
        if work.group is not None:
            self._ungroup(work.group)
        work.charged_s = self.usual_s
        self._had_s[robot] += work.charged_s
        self._running[robot] = self._running.get(robot, 0) + 1
        return work

    def _first_of(self, robots: Collection[bytes]) -> tuple[bytes, float]:
        """Whose request is next, and the least worker time of these robots.

        Of the robots that are little ahead of the least one, that whose answer is useless first.
        """
        least = min(robots, key=lambda robot: (self._had_s[robot], self._lines[robot][0].arrived))
        least_s = self._had_s[least]
        urgent = [one for one in robots if self._lines[one][0].useless_s < math.inf]
        if urgent:
            ahead_s = max(AHEAD_S, self.usual_s)
            near = [one for one in urgent if self._had_s[one] <= least_s + ahead_s]
            least = min(near, key=lambda robot: self._lines[robot][0].useless_s, default=least)
        return least, least_s

    def done(self, work: Work, run_s: float) -> None:
        """A request from `next` has ended after `run_s` in a worker, or never started (0)."""
        robot = work.robot
        self._held.drop(work)
        self._had_s[robot] += run_s - work.charged_s
        if run_s > 0:
            self.usual_s += USUAL_RATE * (run_s - self.usual_s)
        self._running[robot] -= 1
        if not self._running[robot]:
            del self._running[robot]
        if not self._lines and not self._running:
            self._had_s.clear()
            self._least_s, self._hurried = 0.0, False
        elif len(self._had_s) > ROBOTS_MAX:
            asking = self._lines.keys() | self._running.keys()
            self._had_s = {one: self._had_s[one] for one in asking}

    def take(self, matches: Callable[[Work], bool]) -> list[Work]:
        if not self._count:
            return []
        taken = [work for work in self if matches(work)]
        for robot in {work.robot for work in taken}:
            self._lines[robot] = deque(work for work in self._lines[robot] if not matches(work))
            if not self._lines[robot]:
                del self._lines[robot]
        for work in taken:
            self._held.drop(work)
            if work.group is not None:
                self._ungroup(work.group)
        self._count -= len(taken)
        return taken

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[Work]:
        return (work for line in self._lines.values() for work in line)


class _HeldBytes:
    """Memory that requests hold: each body, and each blob once."""

    def __init__(self) -> None:
        self.byte_count = 0
        self._pins: Counter[int] = Counter()  # for the `id` of each blob, the requests that hold it

    def add(self, work: Work) -> None:
        self.byte_count += self.more(work)
        for blob in work.blobs.values():
            self._pins[id(blob)] += 1

    def drop(self, work: Work) -> None:
        for blob in work.blobs.values():
            self._pins[id(blob)] -= 1
            if not self._pins[id(blob)]:
                del self._pins[id(blob)]
        self.byte_count -= self.more(work)

    def more(self, work: Work) -> int:
        """Bytes that no other request holds."""
        own = byte_count(work.request.body)
        for blob in work.blobs.values():
            if id(blob) not in self._pins:
                own += blob.data.nbytes
        return own
