"""What is known of one kind of task: the work of its sizes, and a memory for each site.

What is known of the kind on one site is in `site`; which site a task runs on is decided in `policies`.
"""

import logging
from collections import deque
from collections.abc import Callable, Iterable

from offboard.common.errors import is_interrupt
from offboard.common.tasks import Kind, Size, first_number
from offboard.common.variants import IN_GROUP, group_of
from offboard.robot_client.learning.packing import PackingMemory
from offboard.robot_client.learning.shared_work import SharedWork
from offboard.robot_client.learning.site import SiteMemory
from offboard.robot_client.policies.forecast import WHOLE, Quality
from offboard.robot_client.policies.prediction_errors import ERRORS_MIN
from offboard.robot_client.predictors import Model, Predictor
from offboard.robot_client.predictors.base import REMEMBERED, WARM_UP
from offboard.robot_client.sites.runner import ONBOARD, Execution

log = logging.getLogger(__name__)


class KindMemory:
    """The memory of one kind.

    `make` makes the predictor of one site. With `shared_work`, and if the kind tells the work of its results,
    the sites learn seconds per unit of work instead of seconds per size. With `measured`, heartbeats and load
    count too. The whole quality of an answer is worth `s_per_quality`.
    """

    def __init__(
        self,
        kind: Kind,
        make: Callable[[], Predictor | Model],
        *,
        shared_work: bool,
        measured: bool,
        s_per_quality: float,
    ) -> None:
        self.sites: dict[str, SiteMemory] = {}
        self.last_site: str | None = None  # where the last task was sent
        self.worked: deque[tuple[float, float]] = deque(maxlen=REMEMBERED)  # sizes and their work
        self.kind = kind
        self.packing = PackingMemory(packs=kind.pack is not None)
        self._make = make
        self._measured = measured
        self._s_per_quality = s_per_quality
        self._work = SharedWork() if shared_work and kind.work is not None else None

    @property
    def per_work(self) -> bool:
        """Whether the sites learn seconds per unit of work, not per size."""
        return self._work is not None

    def site(self, name: str) -> SiteMemory:
        """The memory of a site, which is kept when the site leaves; a new server learns from an equal one."""
        found = self.sites.get(name)
        if found is None:
            if len(self.sites) >= REMEMBERED:
                servers = self.sites.keys() - {ONBOARD}
                del self.sites[max(servers, key=lambda site: self.sites[site].age)]
            found = self.sites[name] = SiteMemory(
                name,
                self._make,
                measured=self._measured,
                quality=self._quality(name),
            )
        if IN_GROUP in name and not found.observations:
            self._learn_from_equal(name, found)
        return found

    def _learn_from_equal(self, name: str, found: SiteMemory) -> None:
        """Recall what was last learnt of an equal server: their times differ by what heartbeats measure."""
        equal = [
            one
            for site, one in self.sites.items()
            if group_of(site) == group_of(name) and len(one.observations) >= WARM_UP
        ]
        if equal:
            freshest = min(equal, key=lambda one: one.age)
            last = [one for one in freshest.observations if one.ok][-2 * ERRORS_MIN :]
            found.recall(last, age=freshest.age)

    def _quality(self, site: str) -> Quality:
        if not self.kind.variants:
            return WHOLE
        value = self.kind.at(site).quality
        return Quality(value, self._s_per_quality * (1.0 - value))

    def observations(self, site: str) -> int:
        """How many observations the predictor of a site rests on."""
        return len(self.site(site).model)

    def amount(self, size: Size) -> Size | None:
        """What the predictors are asked for: the expected work of this size, or the size itself."""
        return size if self._work is None else self._work.predict(first_number(size))

    def slowest_onboard_s(self, size: Size) -> float | None:
        """The longest of the last times onboard of no larger tasks; None if the kind never runs twice."""
        return self.site(ONBOARD).slowest_s(self.amount(size)) if self.kind.duplicate else None

    def work_of(self, execution: Execution) -> float | None:
        """The work of a task, by the result of this execution; None if the result does not say."""
        if self._work is None or not execution.ok:
            return None
        try:
            return self.kind.work_of(execution.value)
        except BaseException as error:  # the function is the user's own
            if is_interrupt(error):
                raise
            log.exception("cannot read the work of task %s; remedy: correct its `work`", self.kind.name)
            return None

    def work_of_any(self, executions: Iterable[Execution]) -> float | None:
        """The work of a task, by the first of its executions whose result says it."""
        if self._work is None:
            return None
        return next((work for one in executions if (work := self.work_of(one)) is not None), None)

    def learn_size(self, size: Size, work: float) -> None:
        """Learn that a task of this size had this much work; of several numbers, the first one counts."""
        if self._work is not None:
            self._work.learn(first_number(size), work)
            self.worked.append((first_number(size), work))

    def move_to(self, site: str, reason: str) -> None:
        """Tasks are sent to another site from now on."""
        if self.last_site is not None:
            log.info("%s moves to %s: %s", self.kind.name, site, reason)
        self.last_site = site

    def count_task(self) -> None:
        """Count one more task of this kind, wherever it ran."""
        for memory in self.sites.values():
            memory.age += 1
