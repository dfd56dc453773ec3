"""The bounded lines of accepted requests, one for each robot, and requests that are not let in again."""

from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from offboard.common.wire.blobs import StoredBlob
from offboard.common.wire.messages import Request, byte_count

USUAL_RATE = 0.1  # of the usual run time, with each run
ROBOTS_MAX = 1024  # of which it is known what they had; beyond it those are forgotten that ask for nothing
CRASHES_MAX = 3  # of one request
CRASHED_KEPT = 1024  # requests whose crashes are remembered


@dataclass(slots=True, eq=False)
class Work:
    """An accepted request; it pins its blobs. Times are on the server's monotonic clock."""

    peer: bytes
    request: Request
    blobs: dict[bytes, StoredBlob]
    arrived: float
    robot: bytes  # its public key, or the connection where there are no keys
    queue_s: float = 0.0
    wanted: bool = True
    charged_s: float = 0.0  # to its robot, when it began

    def expired(self, now: float) -> bool:
        return now - self.arrived >= self.request.budget_s


class Waiting:
    """Fair between robots, first come, first served for each; at most `queue_max` requests in all.

    Next is the robot that has had the least of the workers' time, where time without requests counts as
    served (start-time fair queueing, Goyal, Vin and Cheng 1996, with what runs usually take until they are
    over). Where all is taken, the longest line gives way.
    """

    def __init__(self, queue_max: int) -> None:
        self.queue_max = queue_max
        self._lines: dict[bytes, deque[Work]] = {}
        self._running: dict[bytes, int] = {}
        self._had_s: dict[bytes, float] = {}  # worker time of each robot
        self._least_s = 0.0  # of the robot that was last chosen: who comes anew begins there
        self._usual_s = 0.0
        self._count = 0
        self._held = _Held()

    def bytes_with(self, work: Work) -> int:
        """In memory for all requests that wait or run, once this one does."""
        return self._held.byte_count + self._held.more(work)

    def closed_to(self, robot: bytes) -> bool:
        """Whether all is taken, and no other robot's line is longer than this one's would be."""
        return self._count >= self.queue_max and len(self._longest()) <= len(self._lines.get(robot, ())) + 1

    def add(self, work: Work) -> Work | None:
        """Put it in line, unless that is closed to its robot; the request that had to go for it."""
        evicted = None
        if self._count >= self.queue_max:
            line = self._longest()
            evicted = line.pop()
            self._held.drop(evicted)
            self._count -= 1
        self._held.add(work)
        self._had_s[work.robot] = max(self._had_s.get(work.robot, 0.0), self._least_s)
        self._lines.setdefault(work.robot, deque()).append(work)
        self._count += 1
        return evicted

    def _longest(self) -> deque[Work]:
        return max(self._lines.values(), key=len)

    def next(self) -> Work | None:
        """The request to run now; it is charged to its robot until `done` says what it took."""
        if not self._lines:
            return None
        robot = min(self._lines, key=lambda robot: (self._had_s[robot], self._lines[robot][0].arrived))
        self._least_s = self._had_s[robot]
        line = self._lines[robot]
        work = line.popleft()
        if not line:
            del self._lines[robot]
        self._count -= 1
        work.charged_s = self._usual_s
        self._had_s[robot] += work.charged_s
        self._running[robot] = self._running.get(robot, 0) + 1
        return work

    def done(self, work: Work, run_s: float) -> None:
        """What `next` gave out has ended after `run_s` in a worker, 0 where it never began."""
        robot = work.robot
        self._held.drop(work)
        self._had_s[robot] += run_s - work.charged_s
        if run_s > 0:
            self._usual_s += USUAL_RATE * (run_s - self._usual_s)
        self._running[robot] -= 1
        if not self._running[robot]:
            del self._running[robot]
        if not self._lines and not self._running:
            self._had_s.clear()
            self._least_s = 0.0
        elif len(self._had_s) > ROBOTS_MAX:
            asking = self._lines.keys() | self._running.keys()
            self._had_s = {one: self._had_s[one] for one in asking}

    def take(self, matches: Callable[[Work], bool]) -> list[Work]:
        """Remove and return every waiting request that matches."""
        if not self._count:
            return []
        taken = [work for work in self if matches(work)]
        for robot in {work.robot for work in taken}:
            self._lines[robot] = deque(work for work in self._lines[robot] if not matches(work))
            if not self._lines[robot]:
                del self._lines[robot]
        for work in taken:
            self._held.drop(work)
        self._count -= len(taken)
        return taken

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[Work]:
        return (work for line in self._lines.values() for work in line)


class _Held:
    """Bytes that requests keep in memory: each body, and each pinned blob once."""

    def __init__(self) -> None:
        self.byte_count = 0
        self._pins: Counter[int] = Counter()  # requests that pin the blob of this `id`

    def add(self, work: Work) -> None:
        self.byte_count += self.more(work)
        self._pins.update(map(id, work.blobs.values()))

    def drop(self, work: Work) -> None:
        for blob in work.blobs.values():
            self._pins[id(blob)] -= 1
            if not self._pins[id(blob)]:
                del self._pins[id(blob)]
        self.byte_count -= self.more(work)

    def more(self, work: Work) -> int:
        """Bytes that are kept for this request alone."""
        own = byte_count(work.request.body)
        for blob in work.blobs.values():
            if id(blob) not in self._pins:
                own += blob.data.nbytes
        return own


class Crashes:
    """How often a request's worker died of it; of the last CRASHED_KEPT requests with which one did."""

    def __init__(self) -> None:
        self._counts: OrderedDict[tuple[bytes, int], int] = OrderedDict()

    def note(self, peer: bytes, id: int) -> None:
        self._counts[peer, id] = self._counts.pop((peer, id), 0) + 1
        if len(self._counts) > CRASHED_KEPT:
            self._counts.popitem(last=False)

    def too_many(self, peer: bytes, id: int) -> bool:
        return self._counts.get((peer, id), 0) >= CRASHES_MAX

    def __len__(self) -> int:
        return len(self._counts)
