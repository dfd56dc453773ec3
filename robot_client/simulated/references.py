"""References: a task of the run again on each site alone, to know what the better site would have taken.

An offloader of their own runs them: the run learns nothing of them, and they nothing of the run.
"""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from random import Random
from typing import Any

from offboard.common.errors import TaskError
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.records import lines
from offboard.robot_client.records.lines import VERSION, Lines
from offboard.robot_client.records.trace import Record

_FIELDS = ("i", "waited_s", "used", "chosen", "both", "sites")


class References(Lines):
    """Writes a line for every `every`-th of `tasks`; `sites` are those of `offload`, in turning order."""

    def __init__(
        self, path: Path, offload: Offloader, sites: Sequence[str], *, every: int, tasks: int, seed: int
    ) -> None:
        super().__init__("reference", path)
        self._offload = offload
        self._every = every
        self._orders = orders(tasks // every, seed, sites)

    def due(self, number: int) -> bool:
        """Whether task `number` is one of those."""
        return number % self._every == self._every - 1

    def measure(
        self,
        number: int,
        function: Callable[..., Any],
        request: Sequence[Any],
        *,
        waited_s: float,
        record: Record,
    ) -> None:
        """Run the request again; `record` is of the run, which waited so long for its answer."""
        order = self._orders[number // self._every]
        found = {site: self._alone(site, function, request) for site in order}
        fields = {
            "v": VERSION,
            "i": number,
            "waited_s": waited_s,
            "used": record.used,
            "chosen": record.decision.site,
            "both": record.decision.both,
            "sites": {site: one for site, one in found.items() if one is not None},
        }
        self.append(number, fields)

    def _alone(
        self, site: str, function: Callable[..., Any], request: Sequence[Any]
    ) -> dict[str, Any] | None:
        """The execution there; None where the site could not take the task."""
        with contextlib.suppress(TaskError):  # the task's own failure is in the execution
            self._offload(function, *request, where=site)
        record = self._offload.last
        assert record is not None
        for one in record.executions:
            if one.site == site:
                return {"seconds": one.seconds, "ok": one.ok, "censored": one.censored}
        return None


def read(path: Path) -> Iterator[dict[str, Any]]:
    """Each line's fields, as `trace.read`."""
    return lines.read(path, _FIELDS)


def orders(count: int, seed: int, ways: Sequence[str]) -> list[tuple[str, ...]]:
    """An order of `ways` for each of so many tasks; in every `len(ways)` each way is in each place once.

    Whatever a run leaves behind for the next one, warm caches or a spent quota, meets all ways alike.
    """
    random = Random(seed)
    found: list[tuple[str, ...]] = []
    while len(found) < count:
        order = random.sample(ways, len(ways))
        found += [(*order[n:], *order[:n]) for n in range(len(ways))]
    return found[:count]
