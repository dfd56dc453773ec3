"""The trace and the metrics that an offloader writes by itself; how a record is made and observers get it.

What is written is in `trace` and `metrics`.
"""

import atexit
import logging
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from offboard.common.errors import is_interrupt
from offboard.common.live.look import RobotLive
from offboard.robot_client.learning.learner import PendingTask
from offboard.robot_client.learning.regret import Regret
from offboard.robot_client.learning.savings import Savings
from offboard.robot_client.records.record import Late, Record
from offboard.robot_client.records.trace import Trace
from offboard.robot_client.sites.runner import Execution

if TYPE_CHECKING:
    from offboard.robot_client.records.metrics import Metrics

Observer = Callable[[Record], None]

log = logging.getLogger(__name__)


class Recording:
    """A trace file and an address for metrics, both optional, open until `close`.

    trace: the file that records are appended to.
    metrics: HOST:PORT where Prometheus reads `/metrics`.
    """

    def __init__(self, *, trace: Path | str | None, metrics: str | None) -> None:
        self.observers: tuple[Observer, ...] = ()
        self.live: RobotLive[Record] | None = None
        self._served: Metrics | None = None
        with ExitStack() as opened:
            file = self._trace = None if trace is None else Trace(Path(trace))
            if file is not None:
                opened.callback(file.close)
                self.observers += (file.write,)
            if metrics is not None:
                from offboard.robot_client.records.metrics import serve_metrics  # only where it is wanted

                served = self._served = serve_metrics(metrics, "metrics")
                opened.callback(served.close)
                if file is not None:
                    served.watch(file)
                self.observers += (served,)
                self.live = served.live
            self._opened = opened.pop_all()

    def show(self, collector: Any) -> None:
        """Also serve the metrics that `collect` of this object yields, if any are served."""
        if self._served is not None:
            self._served.show(collector)

    def leave_to_parent(self) -> None:
        """In a forked process: its end must not touch the file."""
        if self._trace is not None:
            atexit.unregister(self._trace.close)

    def close(self) -> None:
        """Write the waiting records, and stop serving metrics. Safe to call twice."""
        self._opened.close()


def record_of(
    pending: PendingTask,
    executions: tuple[Execution, ...],
    answer: Execution | None,
    *,
    ended_s: float,
    late: tuple[Late, ...] = (),
    regret: Regret | None = None,
    savings: Savings | None = None,
) -> Record:
    """The record of a task that was answered at `ended_s`, on the clock of the offloader.

    `answer`: None if its caller does not wait for one any more.
    """
    return Record(
        i=pending.i,
        id=pending.id,
        kind=pending.task.kind.name,
        size=pending.task.size,
        sites=pending.forecast.sites,
        decision=pending.decision,
        executions=tuple([execution.without_value() for execution in executions]),
        used=answer.site if answer is not None and answer.ok else None,
        waited_s=ended_s - pending.started_s,
        amount=pending.amount,
        work=pending.work,
        started_s=pending.started_s,
        timeout_s=pending.timeout_s,
        late=late,
        regret=regret,
        started_at=pending.started_at,
        deadline_s=pending.deadline_s,
        savings=savings,
        refused=pending.refused,
        cancelled=pending.cancelled,
    )


def tell(observers: Iterable[Observer], record: Record) -> None:
    """Call each observer. One that fails must not cost the caller its answer, whatever it raises."""
    if log.isEnabledFor(logging.DEBUG):
        _log_task(record)
    for observe in observers:
        try:
            observe(record)
        except BaseException as error:  # an observer is the user's own code
            if is_interrupt(error):
                raise
            log.exception(
                "observer %r failed on task %d (%s); remedy: correct it", observe, record.i, record.kind
            )


def _log_task(record: Record) -> None:
    site, why, used, waited_s = (record.decision.site, record.decision.reason, record.used, record.waited_s)
    text = "task %d of kind %s: answered by %s after %.6f s; chosen: %s: %s"
    fields = {"i": record.i, "kind": record.kind, "used": used, "waited_s": waited_s, "site": site}
    log.debug(text, record.i, record.kind, used or "no site", waited_s, site, why, extra={"task": fields})
