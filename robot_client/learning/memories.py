"""The memories of all kinds of tasks, and when they are saved.

What is known of one kind is in `kind`; the file that memories are saved to is in `store`.
"""

from collections.abc import Callable, Collection

from offboard.common.source.comparison import is_reading
from offboard.common.tasks import Kind
from offboard.robot_client.learning.kind import KindMemory
from offboard.robot_client.learning.memory_file import KeptKind
from offboard.robot_client.learning.store import Store
from offboard.robot_client.policies.objectives import (
    S_PER_QUALITY,
    Deadline,
    Energy,
    Mean,
    Objective,
    Weighing,
)
from offboard.robot_client.predictors import Model, Predictor

Snapshot = dict[str, KeptKind]


class Memories:
    """One memory for each kind, made when the kind is first seen. Called under the offloader's lock.

    `predictor`: makes the predictor of one kind on one site.
    `measured`: heartbeats and load count too, not only the times of tasks.
    `shared_work`: the sites learn seconds per unit of work for kinds that tell the work of their results.
    `objective`: what the policy makes small (None: the mean time).
    `energy`: what tasks take from the battery.
    `s_per_quality`: what the whole quality of an answer is worth, in seconds, for tasks with variants.
    `deadline_s`: of every task, by the objective `deadline`; None for other objectives.
    `store`: the file in which the memories outlive the process (None: they do not).
    """

    def __init__(
        self,
        predictor: Callable[[], Predictor | Model],
        *,
        measured: bool = False,
        shared_work: bool = False,
        objective: Objective | None = None,
        energy: Energy | None = None,
        s_per_quality: float = S_PER_QUALITY,
        store: Store | None = None,
    ) -> None:
        self._predictor = predictor
        self._measured = measured
        self._shared_work = shared_work
        self.weighing = Weighing(objective or Mean(), energy or Energy())
        # The objective `deadline` weighs quality against the chance to miss it, not against seconds.
        self._s_per_quality = 0.0 if isinstance(objective, Deadline) else s_per_quality
        self.deadline_s = objective.deadline_s if isinstance(objective, Deadline) else None
        self._store = store
        self._kinds: dict[str, KindMemory] = {}

    def of(self, kind: Kind, sites: Collection[str]) -> KindMemory:
        """The memory of this kind; a new one, or a new site, recalls what the file holds."""
        found = self._kinds.get(kind.name)
        if found is None:
            found = self._kinds[kind.name] = KindMemory(
                kind,
                self._predictor,
                shared_work=self._shared_work,
                measured=self._measured,
                s_per_quality=self._s_per_quality,
            )
        if self._store is not None and not is_reading(kind):
            self._store.recall(found, sites)
        return found

    def lost_s(self, kind: Kind, site: str) -> float:
        """What the quality that answers of this site lose is worth, in seconds."""
        return self._s_per_quality * (1.0 - kind.at(site).quality) if kind.variants else 0.0

    def due(self, now_s: float) -> bool:
        """Whether the memories should be saved now."""
        return self._store is not None and self._store.due(now_s)

    def save_soon(self) -> None:
        """Save the memories in a thread."""
        if self._store is not None:
            self._store.save_soon(self._store.snapshot(self._kinds))

    def snapshot(self) -> Snapshot:
        """What to save when the process ends."""
        return {} if self._store is None else self._store.snapshot(self._kinds)

    def save_last(self, last: Snapshot) -> None:
        """Save a snapshot before the process ends, and wait for the disk. Called without the lock."""
        if self._store is not None:
            self._store.save_last(last)
