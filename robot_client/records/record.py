"""The record of a task: what was predicted, decided and measured; and its fields as a line of the trace.

Writing lines is left to `trace`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from datetime import datetime, timezone
from typing import Any

from offboard.common.tasks import Size
from offboard.robot_client.learning.regret import Regret
from offboard.robot_client.learning.savings import Savings
from offboard.robot_client.policies import Decision, Hedge, Outlook
from offboard.robot_client.policies.forecast import WHOLE
from offboard.robot_client.records.happened import happened
from offboard.robot_client.records.lines import VERSION
from offboard.robot_client.sites.runner import TIMEOUT_S, UNMEASURED, Condition, Execution

_OUTLOOK_FIELDS = ("predicted_s", "spread_s", "low_s", "high_s", "age", "failures")
_EXECUTION_FIELDS = (
    *("site", "seconds", "ok", "error", "censored", "started", "held_up"),
    *("queue_s", "run_s", "network_s", "cpu_s", "bytes_out", "bytes_in", "after_s"),
)


@dataclass(frozen=True, slots=True)
class Late:
    """An execution that ended after another site had answered; `id` is that of the record of its task."""

    id: str
    execution: Execution


@dataclass(frozen=True, slots=True)
class ChunkRecord:
    """What became of a chunk of a stream, when its call ended.

    outcome: played, late, lost, refused or failed, as `Counts` of streams counts them.
    step: of its observation. asked_step: when it was asked for.
    expected_s: the forecast: after this time since it was asked for it would be late; None: there was none.
    arrived_s: when it came, or was given up, since it was asked for.
    left: for how many steps the queue still had actions. actions: how many the chunk has; 0: it has none.
    dropped, seam: as in `Placed`; None unless it was played.
    """

    outcome: str
    hz: float
    step: int
    asked_step: int
    expected_s: float | None
    arrived_s: float
    left: int
    actions: int = 0
    dropped: int | None = None
    seam: float | None = None


@dataclass(slots=True)
class Record:
    """Everything about one task, made when it is answered, or when its call is cancelled.

    used: the site whose answer was used; None if no site answered, or if the call was cancelled.
    refused: the site of a second run that was due when none was left.
    amount: what the predictors of the sites were asked with: the size, or the work that was expected for it.
    work: what the results told.
    started_s, timeout_s: when the task began, on the clock of the robot; how long a remote site had for it.
    late: executions of earlier tasks that have ended since the record before.
    regret, savings: the present estimates, if there are any; the savings are those of this kind.
    deadline_s: of the call, if it had one. The call missed it if `waited_s`, the time until the answer, is
    longer.
    chunk: of a call that a stream has made.
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
    work: float | None = None
    started_s: float = 0.0
    timeout_s: float = TIMEOUT_S
    late: tuple[Late, ...] = ()
    regret: Regret | None = None
    started_at: datetime = field(default_factory=lambda: datetime.now(timezone.utc))
    deadline_s: float | None = None
    savings: Savings | None = None
    refused: str | None = None
    cancelled: bool = False
    chunk: ChunkRecord | None = None

    @property
    def happened(self) -> str:
        """What became of the task after the decision, in words (docs/offload.md)."""
        return happened(self)

    @property
    def missed_deadline(self) -> bool:
        return self.deadline_s is not None and self.waited_s > self.deadline_s


_REGRET_FIELDS, _SAVINGS_FIELDS, _CHUNK_FIELDS = (
    tuple(one.name for one in fields(of)) for of in (Regret, Savings, ChunkRecord)
)


def as_dict(record: Record) -> dict[str, Any]:
    """The fields of the JSON line (docs/formats.md)."""
    return {
        "v": VERSION,
        "i": record.i,
        "id": record.id,
        "kind": record.kind,
        "started_at": record.started_at.isoformat(timespec="milliseconds"),
        "started_s": record.started_s,
        "timeout_s": record.timeout_s,
        "size": record.size,
        "work": record.work,
        "features": features(record),
        "sites": {site: _outlook(outlook) for site, outlook in record.sites.items()},
        "decision": _decision(record.decision),
        "executions": [_execution(one) for one in record.executions],
        "used": record.used,
        "happened": record.happened,
        "cancelled": record.cancelled,
        "refused": record.refused,
        "waited_s": record.waited_s,
        "deadline_s": record.deadline_s,
        "late": [{"id": one.id} | _execution(one.execution) for one in record.late],
        "regret": _values(record.regret, _REGRET_FIELDS) if record.regret else None,
        "savings": _values(record.savings, _SAVINGS_FIELDS) if record.savings else None,
        "chunk": _values(record.chunk, _CHUNK_FIELDS) if record.chunk else None,
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


def _outlook(outlook: Outlook) -> dict[str, Any]:
    """Only a task with variants has a quality."""
    quality = None if outlook.quality is WHOLE else outlook.quality.value
    packing = None if outlook.packing is None else outlook.packing._asdict()
    sending = outlook.sending._asdict() if outlook.sending.bytes else None
    return _values(outlook, _OUTLOOK_FIELDS) | {"quality": quality, "packing": packing, "sending": sending}


def _execution(execution: Execution) -> dict[str, Any]:
    packed = [one._asdict() for one in execution.packed]
    return _values(execution, _EXECUTION_FIELDS) | {"packed": packed}


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
        "waits": decision.waits,
        "latest_s": None if decision.latest is None else decision.latest.after_s,
        "advised": decision.advised,
    }


def _values(of: object, names: tuple[str, ...]) -> dict[str, Any]:
    return {name: getattr(of, name) for name in names}
