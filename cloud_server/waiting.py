"""The bounded line of accepted requests that wait for a worker."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

from common.blobs import StoredBlob
from common.wire import Request, byte_count


@dataclass(slots=True, eq=False)
class Work:
    """An accepted request; it pins its blobs. Times are on the server's monotonic clock."""

    peer: bytes
    request: Request
    blobs: dict[bytes, StoredBlob]
    arrived: float
    queue_s: float = 0.0
    wanted: bool = True

    def expired(self, now: float) -> bool:
        return now - self.arrived >= self.request.budget_s


class Waiting:
    """First come, first served; at most `queue_max` requests."""

    def __init__(self, queue_max: int) -> None:
        self.queue_max = queue_max
        self._line: deque[Work] = deque()

    @property
    def full(self) -> bool:
        return len(self._line) >= self.queue_max

    def add(self, work: Work) -> None:
        assert not self.full
        self._line.append(work)

    def next(self) -> Work | None:
        return self._line.popleft() if self._line else None

    def take(self, matches: Callable[[Work], bool]) -> list[Work]:
        """Remove and return every waiting request that matches."""
        taken = [work for work in self._line if matches(work)]
        if taken:
            self._line = deque(work for work in self._line if not matches(work))
        return taken

    def __len__(self) -> int:
        return len(self._line)

    def __iter__(self) -> Iterator[Work]:
        return iter(self._line)


def held_bytes(works: Iterable[Work]) -> int:
    """Memory that these requests keep: each body, and each pinned blob once."""
    works = list(works)
    blobs = {id(blob): blob.data.nbytes for work in works for blob in work.blobs.values()}
    return sum(byte_count(work.request.body) for work in works) + sum(blobs.values())
