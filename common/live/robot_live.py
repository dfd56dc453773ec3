"""What the page `/live` of a robot shows: its last records, and its sites as they are now.

It reads them through protocols, so that a robot's own package stays small. `live_port` serves the page.
"""

import time
from collections import deque
from collections.abc import Callable, Generator, Mapping
from datetime import UTC, datetime, timedelta
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

from offboard.common.live.look import EVERY_S, KEPT_MAX, Look
from offboard.common.tasks import Kind, kinds

TASKS_MAX = 15  # of a look after the first one: a viewer costs a robot with a tenth of a CPU less than 2 %
WATCHED_S = 2 * EVERY_S  # after a look, until the next one is due
LONG_AGO = datetime.min.replace(tzinfo=UTC)
SPENT = ("duplicates", "bytes_left", "joules_left")

R = TypeVar("R")


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
            self._watched_until = datetime.now(UTC) + timedelta(seconds=WATCHED_S)
            self.due_at = LONG_AGO
            new, last = self._after(last)
            lines = [self._line(record) for record in new[-most:]]
            kind = lines[-1]["kind"] if lines else kind
            yield Look(
                "robot",
                time.time(),
                lines,
                sites=self._conditions(kind),
                budget=self._budget(),
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

    def _budget(self) -> dict[str, float] | None:
        return None if self._allowance is None else {name: getattr(self._allowance, name) for name in SPENT}
