"""What a task takes on each site alone: references during a run, and the tasks of --alone after it.

Both have their own offloader, so that they and the run learn nothing from each other.
"""

import contextlib
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

from offboard.common.errors import TaskError
from offboard.common.task_states import TaskStates
from offboard.common.tasks import kind_of
from offboard.loadgen.progress import progress
from offboard.loadgen.robot.config import RobotConfig
from offboard.loadgen.robot.summary import PROGRESS_EVERY, describe
from offboard.loadgen.robot.work import Work
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.policies import BOTH
from offboard.robot_client.records.lines import VERSION, Lines
from offboard.robot_client.records.record import Record
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

WAYS = (ONBOARD, CLOUD, BOTH)


class References(Lines):
    """Measures every `every`-th of `tasks` tasks and writes one line for each.

    `sites` are the sites of `offload`; their order changes from task to task. `states` are those of the run.
    """

    def __init__(
        self,
        path: Path,
        offload: Offloader,
        sites: Sequence[str],
        *,
        every: int,
        tasks: int,
        seed: int,
        states: TaskStates,
    ) -> None:
        super().__init__("reference", path)
        self._offload = offload
        self._states = states
        self._every = every
        self._orders = orders(tasks // every, seed, sites)

    def due(self, number: int) -> bool:
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
        """Run the request again on each site; `record` and `waited_s` say how the run itself fared."""
        with contextlib.suppress(TaskError), self._states.lend(kind_of(function).at(ONBOARD)):
            pass  # a run that lost its race may still use the state; no reference must wait for it
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
        """The execution on the site; None if the site could not take the task."""
        with contextlib.suppress(TaskError):  # the execution holds the failure of the task
            self._offload(function, *request, where=site)
        record = self._offload.last
        assert record is not None
        for one in record.executions:
            if one.site == site:
                return {"seconds": one.seconds, "ok": one.ok, "censored": one.censored}
        return None


def measure_alone(config: RobotConfig, work: Work, offload: Offloader, say: Callable[[str], None]) -> None:
    """Run `config.alone` further tasks in all WAYS, one way after the other, in an order that changes.

    The times say how much the two executions of one task disturb each other; `loadgen table` reads them.
    The only sites of `offload` are onboard and cloud.
    """
    whole, runs = 0, config.alone * len(WAYS)
    with progress("on each site alone", runs, to=sys.stdout, every=PROGRESS_EVERY) as shown:
        for order in orders(config.alone, config.seed, WAYS):
            request, ran = work.request(), 0
            for way in order:
                answer = offload(work.function, *request, where=way)
                record = offload.last
                assert record is not None
                ran += _ran(record, way)
                shown.step(partial(describe, record))
            work.advance(answer)
            whole += ran == len(WAYS)
    missing = f"; the {CLOUD} did not answer for the others" if whole < config.alone else ""
    say(f"run on each site alone and on both at once: {whole} of {config.alone} {work.noun}{missing}")


def orders(count: int, seed: int, ways: Sequence[str]) -> list[tuple[str, ...]]:
    """An order of `ways` for each of `count` tasks; in every `len(ways)` tasks, each way has each place once.

    One execution may leave warm caches or a spent quota to the next; this way no way gains from it.
    """
    random = Random(seed)
    found: list[tuple[str, ...]] = []
    while len(found) < count:
        order = random.sample(ways, len(ways))
        found += [(*order[n:], *order[:n]) for n in range(len(ways))]
    return found[:count]


def _ran(record: Record, way: str) -> bool:
    """Whether the task ran well on the sites of `way`, and on no other."""
    sites = [ONBOARD, CLOUD] if way == BOTH else [way]
    return sorted(one.site for one in record.executions if one.ok) == sorted(sites)
