"""The trace and the metrics that an offloader writes by itself, and how observers get a record.

What is written is in `trace` and `metrics`.
"""

import atexit
import logging
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from pathlib import Path

from offboard.common.errors import is_interrupt
from offboard.robot_client.records.trace import Record, Trace

Observer = Callable[[Record], None]

log = logging.getLogger(__name__)


class Recording:
    """A trace file and an address for metrics, both optional, open until `close`.

    trace: the file that records are appended to.
    metrics: HOST:PORT where Prometheus reads `/metrics`.
    """

    def __init__(self, *, trace: Path | str | None, metrics: str | None) -> None:
        self.observers: tuple[Observer, ...] = ()
        with ExitStack() as opened:
            file = self._trace = None if trace is None else Trace(Path(trace))
            if file is not None:
                opened.callback(file.close)
                self.observers += (file.write,)
            if metrics is not None:
                from offboard.robot_client.records.metrics import serve_metrics  # only where it is wanted

                served = serve_metrics(metrics, "metrics")
                opened.callback(served.close)
                if file is not None:
                    served.watch(file)
                self.observers += (served,)
            self._opened = opened.pop_all()

    def leave_to_parent(self) -> None:
        """In a forked process: its end must not touch the file."""
        if self._trace is not None:
            atexit.unregister(self._trace.close)

    def close(self) -> None:
        """Write the waiting records, and stop serving metrics. Safe to call twice."""
        self._opened.close()


def tell(observers: Iterable[Observer], record: Record) -> None:
    """Call each observer. One that fails must not cost the caller its answer, whatever it raises."""
    for observe in observers:
        try:
            observe(record)
        except BaseException as error:  # an observer is the user's own code
            if is_interrupt(error):
                raise
            log.exception("observer %r failed on task %d (%s)", observe, record.i, record.kind)
