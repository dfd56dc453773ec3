"""A request to a server of ours: the message that it is sent as, and the execution that its reply means."""

from dataclasses import dataclass

from offboard.common.errors import (
    CannotCross,
    CloudBroken,
    CloudBusy,
    OffloadError,
    ProtocolError,
    TaskFailed,
    of_task,
)
from offboard.common.wire import messages as wire
from offboard.robot_client.sites.conversation import PendingRequest
from offboard.robot_client.sites.outgoing import Outgoing
from offboard.robot_client.sites.runner import Execution, Packed


@dataclass(eq=False, slots=True, kw_only=True)
class WireRequest(PendingRequest):
    """One request to the server of `site`.

    outgoing: what of the arguments is inside the body, and what was packed.
    attempt: how often it was sent, counted from 1.
    last_message: the number of the message that carried it last; 0 if it was never sent.
    doubtful: whether its large arguments were only named, and the server may lack one of them.
    key: what must be equal for requests that run together.
    """

    body: wire.Body
    outgoing: Outgoing
    attempt: int = 1
    last_message: int = 0
    doubtful: bool = False
    key: str = ""

    @property
    def packed(self) -> tuple[Packed, ...]:
        return self.outgoing.packed

    def message(self, now_s: float) -> wire.Request:
        request = wire.Request(
            id=self.task.id,
            kind=self.task.kind.at(self.site).name,
            budget_s=self.deadline_s - now_s,
            attempt=self.attempt,
            blobs=tuple(self.body.blobs),
            body=self.body.frames,
        )
        if self.key:
            request.key = self.key
        if self.task.useless_s is not None:
            request.useless_s = max(0.0, self.task.useless_s - now_s)
        return request

    def answered(self, reply: wire.Reply, received_s: float, bytes_in: int) -> Execution:
        value, failure = None, _failure(self.task.kind.name, reply)
        if failure is None:
            try:
                value = wire.decode(reply.body, self.task.kind.types, {})
            except ProtocolError as error:
                failure = CannotCross(f"result: {error}")
        seconds, packed = received_s - self.published_s, self.packed
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
    return CloudBroken(text) if reply.status == "unknown_task" else CloudBusy(text)  # busy or expired
