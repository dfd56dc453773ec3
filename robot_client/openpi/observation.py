"""An observation under way to a policy server, and the execution that its answer becomes.

Sending it, and deciding when to give it up, is left to `policy_server`.
"""

import asyncio
import math
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any

from offboard.common.errors import CloudBroken, CloudError, ProtocolError
from offboard.common.tasks import Task
from offboard.robot_client.openpi.numpy_msgpack import unpack
from offboard.robot_client.sites.runner import Execution

TEXT_LENGTH_MAX = 200  # of an error of the server, in logs and records


@dataclass(eq=False, slots=True)
class Observation:
    """The observation of one task, as bytes. Times are readings of `time.perf_counter`.

    sent_s: when it was sent; None while it waits.
    given_up_s: when the task got its execution without an answer; None: it did not.
    """

    site: str
    task: Task
    data: bytes
    published_s: float
    deadline_s: float
    future: "Future[Execution]" = field(default_factory=Future)
    timer: asyncio.TimerHandle | None = None
    sent_s: float | None = None
    given_up_s: float | None = None

    @property
    def given_up(self) -> bool:
        return self.given_up_s is not None

    def answered(self, message: bytes | str, now_s: float) -> Execution:
        """The execution that the answer means; the server says in it how long it computed, if it does."""
        value, failure = _action(message)
        seconds = now_s - self.published_s
        queue_s = (self.sent_s or now_s) - self.published_s
        run_s = _run_s(value)
        if run_s is not None and run_s > seconds - queue_s:
            run_s = None
        return Execution(
            self.site,
            seconds,
            value,
            failure,
            queue_s=queue_s,
            run_s=run_s,
            network_s=None if run_s is None else seconds - queue_s - run_s,
            bytes_out=len(self.data),
            bytes_in=len(message.encode() if isinstance(message, str) else message),
        )

    def gave_up(self, failure: CloudError, now_s: float, *, censored: bool) -> Execution:
        """The execution without an answer."""
        self.given_up_s = now_s
        started = self.sent_s is not None
        return Execution(
            self.site,
            now_s - self.published_s,
            failure=failure,
            censored=censored,
            bytes_out=len(self.data) if started else 0,
            started=started,
        )


def shortened(text: str) -> str:
    """The last line of a text, which in a traceback is the error."""
    return (text.strip().splitlines() or [""])[-1][:TEXT_LENGTH_MAX]


def _action(message: bytes | str) -> tuple[Any, CloudBroken | None]:
    """The action in a message, or why there is none. Either way the server is at fault, not the task."""
    if isinstance(message, str):
        return None, CloudBroken(f"the policy server failed: {shortened(message)}")
    try:
        value = unpack(message)
    except ProtocolError as error:
        return None, CloudBroken(f"answer: {error}")
    if isinstance(value, dict) and isinstance(value.get("type"), str) and value["type"] == "error":
        return None, CloudBroken(f"the policy server failed: {shortened(str(value.get('message')))}")
    return value, None


def _run_s(value: Any) -> float | None:
    """The computing time that the server says, in seconds; None if it says nothing of the sort."""
    timing = value.get("server_timing") if isinstance(value, dict) else None
    ms = timing.get("infer_ms") if isinstance(timing, dict) else None
    if isinstance(ms, bool) or not isinstance(ms, int | float) or not (math.isfinite(ms) and ms >= 0):
        return None
    return ms / 1000
