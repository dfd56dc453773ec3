"""A request in flight, and the execution that it becomes.

Sending it, and deciding when to give it up, is left to `cloud`.
"""

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass

from offboard.common.errors import (
    CannotCross,
    CloudBroken,
    CloudBusy,
    CloudError,
    OffloadError,
    ProtocolError,
    TaskFailed,
    of_task,
)
from offboard.common.tasks import Task
from offboard.common.wire import messages as wire
from offboard.robot_client.sites.outgoing import Outgoing
from offboard.robot_client.sites.runner import Execution


@dataclass(eq=False)
class PendingRequest:
    """One request to the server of `site`. Times are readings of `time.perf_counter`.

    outgoing: what of the arguments is inside the body, and what was packed.
    attempt: how often it was sent, counted from 1.
    last_message: the number of the message that carried it last; 0 if it was never sent.
    doubtful: whether its large arguments were only named, and the server may lack one of them.
    """

    site: str
    task: Task
    body: wire.Body
    published_s: float
    deadline_s: float
    future: "Future[Execution]"
    outgoing: Outgoing
    attempt: int = 1
    bytes_out: int = 0
    last_message: int = 0
    doubtful: bool = False

    def message(self, now_s: float) -> wire.Request:
        return wire.Request(
            id=self.task.id,
            kind=self.task.kind.at(self.site).name,
            budget_s=self.deadline_s - now_s,
            attempt=self.attempt,
            blobs=tuple(self.body.blobs),
            body=self.body.frames,
        )

    def answered(self, reply: wire.Reply, received_s: float, bytes_in: int) -> Execution:
        value, failure = None, _failure(self.task.kind.name, reply)
        if failure is None:
            try:
                value = wire.decode(reply.body, self.task.kind.types, {})
            except ProtocolError as error:
                failure = CannotCross(f"result: {error}")
        seconds, packed = received_s - self.published_s, self.outgoing.packed
        pack_s = sum([one.seconds for one in packed])
        return Execution(
            self.site,
            seconds,
            value,
            failure,
            queue_s=reply.queue_s,
            run_s=reply.run_s,
            network_s=max(0.0, seconds - reply.queue_s - reply.run_s - pack_s),
            cpu_s=reply.cpu_s,
            bytes_out=self.bytes_out,
            bytes_in=bytes_in,
            started=reply.status in ("ok", "failed") and not _unread(reply),
            packed=packed,
        )

    def given_up(
        self, failure: CloudError, now_s: float, *, censored: bool = False, started: bool = True
    ) -> Execution:
        return Execution(
            self.site,
            now_s - self.published_s,
            failure=failure,
            censored=censored,
            bytes_out=self.bytes_out,
            started=started and self.last_message > 0,
            packed=self.outgoing.packed,
        )


_FAILURES: dict[str, Callable[[str], OffloadError]] = {
    "busy": CloudBusy,
    "expired": CloudBusy,
    "unknown_task": CloudBroken,
}


def _unread(reply: wire.Reply) -> bool:
    """Whether the server could not read or unpack the arguments, so that the task did not begin."""
    return reply.server_fault and reply.error.startswith("ProtocolError: ")


def _failure(kind: str, reply: wire.Reply) -> OffloadError | None:
    if reply.status == "ok":
        return None
    text = reply.error or reply.status
    if reply.status == "failed" and not reply.server_fault:
        return TaskFailed(of_task(kind, text), reply.traceback)
    if reply.server_fault:
        of_value = text.startswith(("BadValue: ", "ProtocolError: "))
        return (CannotCross if of_value else CloudBroken)(text.removeprefix("BadValue: "))
    return _FAILURES[reply.status](text)
