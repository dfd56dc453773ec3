"""What a viewer of `/live` gets: one look a second, as plain data, from a robot, a server or a run."""

import json
import math
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from datetime import datetime, timedelta, timezone
from threading import Lock
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

from offboard.common.tasks import Kind, kinds

EVERY_S = 1.0  # between two looks: the page shows an outage within two of them
VIEWERS_MAX = 8  # pages that one port serves at the same time
KEPT_MAX = 1000  # tasks that a process keeps for the next viewer
TASKS_MAX = 15  # of a look after the first one: a viewer costs a robot with a tenth of a CPU less than 2 %
WATCHED_S = 2 * EVERY_S  # after a look, until the next one is due
LONG_AGO = datetime.min.replace(tzinfo=timezone.utc)
SPENT = ("duplicates", "bytes_left", "joules_left")

R = TypeVar("R")


@dataclass(frozen=True, slots=True)
class Look:
    """What is new since the last look of the same viewer, and how things are now.

    source: `robot`, `server`, `run`, or `report` for a run in a file; the page shows what this source has.
    now_s: Unix time of the source.
    tasks: lines of the trace (docs/formats.md); with several robots, each with the name of its `robot`.
    events: lines of a run's `events.jsonl`, each with its Unix time `at_s`.
    sites: by name, how each site is now: the fields of its condition, and why it is `absent`, or null.
    budget: what may still be spent; None if it is unknown.
    server: the state of a server; None for the others.
    left_out: tasks since the last look that are not among `tasks`, because there were too many.
    over: nothing will be added any more.
    """

    source: str
    now_s: float
    tasks: Sequence[Mapping[str, Any]] = ()
    events: Sequence[Mapping[str, Any]] = ()
    sites: Mapping[str, Mapping[str, Any]] | None = None
    budget: Mapping[str, float | None] | None = None
    server: Mapping[str, Any] | None = None
    left_out: int = 0
    over: bool = False


class Source(Protocol):
    """Whatever can be looked at."""

    def looks(self) -> Generator[Look]:
        """The looks of one viewer, without an end. The caller asks for the next one when it is due.

        Until it is asked, nothing is done: a source that nobody looks at costs nothing.
        """


class Viewers:
    """Counts the viewers of one port. Any thread may call this."""

    REFUSAL = f"{VIEWERS_MAX} pages are open, which is the most; close one of them\n"

    def __init__(self) -> None:
        self._lock = Lock()
        self._count = 0

    @property
    def full(self) -> bool:
        return self._count >= VIEWERS_MAX

    @contextmanager
    def one(self, looks: Generator[Look]) -> Iterator[None]:
        """One more viewer until the end, when its looks are closed."""
        with self._lock:
            self._count += 1
        try:
            yield
        finally:
            looks.close()
            with self._lock:
                self._count -= 1


_FIELDS = tuple(one.name for one in fields(Look))


def encode(look: Look) -> bytes:
    """The look as a server-sent event."""
    return b"data: " + as_json(look) + b"\n\n"


def as_json(look: Look) -> bytes:
    """The look as JSON, which has no infinity: None is in its place."""
    values = {name: getattr(look, name) for name in _FIELDS}
    try:
        text = json.dumps(values, separators=(",", ":"), allow_nan=False)
    except ValueError:
        text = json.dumps(_finite(values), separators=(",", ":"), allow_nan=False)
    return text.encode()


def _finite(value: Any) -> Any:
    """The same value with None in place of each number that is not finite."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {name: _finite(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(one) for one in value]
    return value


class Site(Protocol):
    """What the page asks a runner of the robot."""

    def condition(self) -> NamedTuple: ...

    def unavailable(self, kind: Kind) -> str | None: ...


class RobotLive(Generic[R]):
    """The source of a robot's page. All but `keep` is left to the viewers.

    line: makes the line of the trace of a record.
    due_at: `keep` the records of tasks that start then or later. Asking for it costs a task less than a call.
    """

    def __init__(self, line: Callable[[R], Mapping[str, Any]]) -> None:
        self._line = line
        self._records: deque[R] = deque(maxlen=KEPT_MAX)
        self.due_at = self._watched_until = LONG_AGO
        self.sites: Mapping[str, Site] = {}
        self._allowance: object = None

    def show(self, sites: Mapping[str, Site], allowance: object) -> None:
        """Also show these sites, and what may be spent. They are read without a lock, for people."""
        self.sites, self._allowance = sites, allowance

    def keep(self, record: R, started_at: datetime) -> None:
        """Keep the record of a task; while nobody looks, one of each EVERY_S.

        Each record that is kept costs the garbage collector about 1 % of what it takes to make it.
        """
        self._records.append(record)
        if started_at >= self._watched_until:
            self.due_at = started_at + timedelta(seconds=EVERY_S)

    def looks(self) -> Generator[Look]:
        last, kind, most = None, None, KEPT_MAX
        while True:
            self._watched_until = datetime.now(timezone.utc) + timedelta(seconds=WATCHED_S)
            self.due_at = LONG_AGO
            new, last = self._after(last)
            lines = [self._line(record) for record in new[-most:]]
            kind = lines[-1]["kind"] if lines else kind
            yield Look(
                "robot",
                time.time(),
                lines,
                sites=self._conditions(kind),
                budget=None
                if self._allowance is None
                else {one: getattr(self._allowance, one) for one in SPENT},
                left_out=len(new) - len(lines),
            )
            most = TASKS_MAX

    def _after(self, last: R | None) -> tuple[list[R], R | None]:
        """The records after `last`, or all that are kept; and the last one of them."""
        new: list[R] = []
        for record in reversed(self._records.copy()):
            if record is last:
                break
            new.append(record)
        return new[::-1], new[0] if new else last

    def _conditions(self, kind: str | None) -> dict[str, dict[str, Any]]:
        """How each site is, and why it cannot take a task of this kind."""
        asked = next((one for one in kinds() if one.name == kind), None)
        return {
            name: {**site.condition()._asdict(), "absent": asked and site.unavailable(asked)}
            for name, site in self.sites.items()
        }
