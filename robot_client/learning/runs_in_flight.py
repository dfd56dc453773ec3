"""The runs that are under way on each site, and how long they should still take.

They are started and ended by the offloader.
"""

from dataclasses import dataclass

OVERDUE = 0.5  # of its time so far: an overdue run should still need this long


@dataclass(slots=True)
class _Flight:
    """`began_s`: when it started; if it waited for other runs, when the last of them ended."""

    kind: str
    began_s: float
    predicted_s: float

    def left_s(self, now_s: float) -> float:
        so_far_s = now_s - self.began_s
        return max(self.predicted_s - so_far_s, OVERDUE * so_far_s)


class Flights:
    """The runs under way, by site and task. Called under the offloader's lock."""

    def __init__(self) -> None:
        self._flights: dict[str, dict[int, _Flight]] = {}  # of the sites that have any

    def begin(self, site: str, task: int, *, kind: str, predicted_s: float, now_s: float) -> None:
        """A run of the task with this id starts; it is predicted to take this long once it has its turn."""
        self._flights.setdefault(site, {})[task] = _Flight(kind, now_s, predicted_s)

    def end(self, site: str, task: int, *, now_s: float) -> None:
        """The run has ended, and the next one has its turn. Safe to call twice."""
        flights = self._flights.get(site, {})
        had_turn = task == next(iter(flights), None)
        flights.pop(task, None)
        if not flights:
            self._flights.pop(site, None)
        elif had_turn:
            next(iter(flights.values())).began_s = now_s

    def end_all(self, task: int, *, now_s: float) -> None:
        """All runs of the task were given up."""
        for site in list(self._flights):
            self.end(site, task, now_s=now_s)

    def count(self, site: str) -> int:
        return len(self._flights.get(site, ()))

    def has(self, site: str, kind: str) -> bool:
        """Whether a task of this kind runs there."""
        return any(one.kind == kind for one in self._flights.get(site, {}).values())

    def left_s(self, site: str, now_s: float) -> float:
        """How long the runs on this site should still take. They run one after the other."""
        runs = list(self._flights.get(site, {}).values())
        return sum([one.left_s(now_s) for one in runs[:1]]) + sum([one.predicted_s for one in runs[1:]])
