"""The calls of a stream: each one runs on the site that it is sent to, and nowhere else.

How a call is made is in `calls`, at the top of the package.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from offboard.common.errors import OffloadError
from offboard.common.tasks import Kind
from offboard.robot_client.execution.call_future import CallFuture
from offboard.robot_client.records.record import ChunkRecord
from offboard.robot_client.sites.runner import Execution, Runner
from offboard.robot_client.sites.waiting import Clock


class StreamCalls:
    """What a stream asks of its offloader, for one kind.

    sites: returns the sites as they are now. lost_s: what the quality that a site loses is worth, in seconds.
    submit: begins a call with these arguments, this site and this time, in seconds. closed: whether the
    offloader is. refuse_in_fork: OffloadError in a process that was forked from that of the offloader.
    steps_itself: in virtual time there are no threads, and the simulation looks at the queue.
    """

    def __init__(
        self,
        kind: Kind,
        clock: Clock,
        *,
        sites: Callable[[], Mapping[str, Runner]],
        lost_s: Callable[[Kind, str], float],
        submit: Callable[[tuple[Any, ...], str, float, CallFuture[Any]], CallFuture[Any]],
        closed: Callable[[], bool],
        refuse_in_fork: Callable[[], None],
        steps_itself: bool = False,
    ) -> None:
        self.clock, self.steps_itself = clock, steps_itself
        self._kind = kind
        self._sites = sites
        self._lost_s = partial(lost_s, kind)
        self._submit = submit
        self._closed = closed
        self._refuse_in_fork = refuse_in_fork

    def able(self) -> Mapping[str, float]:
        self.refuse()
        return {
            site: self._lost_s(site)
            for site, runner in self._sites().items()
            if runner.unavailable(self._kind) is None and not runner.condition().silent
        }

    def call(
        self,
        item: Any,
        site: str,
        timeout_s: float,
        take: Callable[[Execution], ChunkRecord | None],
        *,
        useful_s: float | None = None,
    ) -> CallFuture[Any]:
        future = CallFuture[Any](falls_back=False, useful_s=useful_s)
        future.take = take
        return self._submit(self._kind.arguments_in(item), site, timeout_s, future)

    def quality(self, site: str) -> float:
        return self._kind.at(site).quality

    def refuse(self) -> None:
        self._refuse_in_fork()
        if self._closed():
            raise OffloadError("the offloader is closed")
