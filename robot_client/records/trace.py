"""The record of a task, and the trace: one JSON line per task with what was predicted, decided and measured.

Writing lines so that they survive a crash is left to `lines`.
"""

import atexit
import threading
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self

from offboard.common.tasks import Size
from offboard.robot_client.learning.regret import Regret
from offboard.robot_client.policies import Decision, Hedge, Outlook
from offboard.robot_client.records.lines import VERSION, Lines
from offboard.robot_client.sites.runner import UNMEASURED, Condition, Execution

WRITE_EVERY_S = 0.5
WAITING_MAX = 1000  # records in memory; the thread that adds one more writes them all

_OUTLOOK_FIELDS = ("predicted_s", "spread_s", "low_s", "high_s", "age", "failures")
_EXECUTION_FIELDS = (
    "site",
    "seconds",
    "ok",
    "error",
    "censored",
    "queue_s",
    "run_s",
    "network_s",
    "cpu_s",
    "bytes_out",
    "bytes_in",
)


@dataclass(frozen=True, slots=True)
class Late:
    """An execution that ended after another site had answered; `id` is that of the record of its task."""

    id: str
    site: str
    seconds: float
    ok: bool
    censored: bool

    @classmethod
    def of(cls, id: str, site: str, execution: Execution) -> Self:
        return cls(id, site, seconds=execution.seconds, ok=execution.ok, censored=execution.censored)


@dataclass(slots=True)
class Record:
    """Everything about one task, made when it is answered.

    used: the site whose answer was used; None if no site answered.
    amount: what the predictors of the sites were asked with: the size, or the work that was expected for it.
    late: executions of earlier tasks that have ended since the record before.
    regret: the present estimate, if there is one.
    """

    i: int
    id: str
    kind: str
    size: Size
    sites: Mapping[str, Outlook]
    decision: Decision
    executions: tuple[Execution, ...]
    used: str | None
    waited_s: float
    amount: Size | None = None
    late: tuple[Late, ...] = ()
    regret: Regret | None = None
    started_at: datetime = field(default_factory=lambda: datetime.now(UTC))


_LATE_FIELDS, _REGRET_FIELDS = (tuple(one.name for one in fields(of)) for of in (Late, Regret))


class Trace(Lines):
    """Appends records to a file, in order. A line that cannot be written is logged; tasks go on.

    A thread writes the waiting records every WRITE_EVERY_S. With a tenth of a CPU, writing between two tasks
    would delay the next one. A crash loses the waiting records.
    """

    def __init__(self, path: Path) -> None:
        super().__init__("trace", path)
        self._waiting: deque[Record] = deque()
        self._writing = threading.Lock()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="trace", daemon=True)
        self._thread.start()
        atexit.register(self.close)  # a program that does not close the trace loses no record

    def write(self, record: Record) -> None:
        """Add a record. Any thread may call this."""
        self._waiting.append(record)
        if len(self._waiting) >= WAITING_MAX or self._closing.is_set():
            self.flush()

    def close(self) -> None:
        """Write all waiting records, and close the file. Safe to call twice."""
        atexit.unregister(self.close)
        self._closing.set()
        self._thread.join()
        self.flush()
        super().close()

    def flush(self) -> None:
        """Write all waiting records. Any thread may call this."""
        with self._writing:
            while self._waiting:
                record = self._waiting.popleft()
                self.append(record.i, as_dict(record))

    def _run(self) -> None:
        while not self._closing.wait(WRITE_EVERY_S):
            self.flush()


def as_dict(record: Record) -> dict[str, Any]:
    """The fields of the JSON line (docs/formats.md)."""
    return {
        "v": VERSION,
        "i": record.i,
        "id": record.id,
        "kind": record.kind,
        "started_at": record.started_at.isoformat(timespec="milliseconds"),
        "size": record.size,
        "features": features(record),
        "sites": {site: _values(outlook, _OUTLOOK_FIELDS) for site, outlook in record.sites.items()},
        "decision": _decision(record.decision),
        "executions": [_values(one, _EXECUTION_FIELDS) for one in record.executions],
        "used": record.used,
        "waited_s": record.waited_s,
        "late": [_values(one, _LATE_FIELDS) for one in record.late],
        "regret": _values(record.regret, _REGRET_FIELDS) if record.regret else None,
    }


def features(record: Record) -> dict[str, float]:
    """What was measured, by name; a value of a site is named SITE.NAME."""
    found: dict[str, float] = {}
    amount = record.amount
    if not (amount is None or isinstance(amount, tuple) or amount == record.size):
        found["work"] = amount
    for site, outlook in record.sites.items():
        if outlook.condition is not UNMEASURED:
            for name, value in zip(Condition._fields, outlook.condition, strict=True):
                if value is not None:
                    found[f"{site}.{name}"] = value
    return found


def _decision(decision: Decision) -> dict[str, Any]:
    """A probe is a second run after 0 s."""
    second = decision.second
    return {
        "site": decision.site,
        "both": decision.both,
        "reason": decision.reason,
        "policy": decision.policy,
        "second": None if second is None else second.site,
        "second_after_s": second.after_s if isinstance(second, Hedge) else 0.0,
        "spared": decision.spared,
    }


def _values(of: object, names: tuple[str, ...]) -> dict[str, Any]:
    return {name: getattr(of, name) for name in names}
