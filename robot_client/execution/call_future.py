"""The future of one call: it can be cancelled while the call runs, and holds its record."""

from collections.abc import Callable
from concurrent.futures import Future, InvalidStateError, wait
from contextlib import suppress
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from offboard.robot_client.records.record import ChunkRecord, Record
    from offboard.robot_client.sites.runner import Execution

RECORD_WAIT_S = 5.0  # a cancelled call leaves its runs within milliseconds

R = TypeVar("R")


class CallFuture(Future[R]):
    """What `submit` returns. Unlike those of an executor, `cancel` also ends a call that has begun.

    Its state stays pending until it is done, as a future that runs cannot be cancelled.
    `stop`: done once the call is cancelled; its thread then leaves the runs.
    `withdraw`: what cancels the runs that are under way; a batch has one future for all of its calls.
    `useful_s`: how long the answer is of use, in seconds; None: as long as the call waits for it.
    `falls_back`: whether the call runs onboard if its site fails.
    `take`: called with the answer, or the failure, before the record is made; what it returns is the chunk of
    the record.
    """

    def __init__(self, *, falls_back: bool = True, useful_s: float | None = None) -> None:
        super().__init__()
        self.falls_back, self.useful_s = falls_back, useful_s
        self.take: Callable[[Execution], ChunkRecord | None] | None = None
        self.stop: Future[None] = Future()
        self.withdraw: set[Callable[[], None]] = set()
        self._begun = False
        self._recorded: Future[Record | None] = Future()

    @property
    def record(self) -> "Record | None":
        """The record of the call once it is done; None before, and if the call has not begun.

        After `cancel` this waits until the runs of the call are left, for at most RECORD_WAIT_S.
        """
        if self.done():
            wait([self._recorded], RECORD_WAIT_S)
        return self._recorded.result() if self.done() and self._recorded.done() else None

    def keep(self, record: "Record | None") -> "Record | None":
        """Keep the record of the call; returns the one that is kept, which is the first."""
        with suppress(InvalidStateError):
            self._recorded.set_result(record)
        return self._recorded.result()

    def cancel(self) -> bool:
        """End the call. False if it was done before.

        A run that waits at its site is withdrawn, and one that has begun is asked to stop (`check_wanted`).
        """
        if not super().cancel():
            return False
        with suppress(InvalidStateError):  # it was cancelled before
            self.stop.set_result(None)
            for withdraw in tuple(self.withdraw):
                withdraw()
            super().set_running_or_notify_cancel()  # or a wait for several futures would go on
            if not self._begun:
                self.keep(None)
        return True

    def running(self) -> bool:
        return self._begun and not self.done()

    def set_running_or_notify_cancel(self) -> bool:
        """Begin the call, in its thread. False if it was cancelled before."""
        self._begun = True
        if cancelled := self.cancelled():
            self.keep(None)
        return not cancelled

    def set_result(self, result: R) -> None:
        with suppress(InvalidStateError):  # it was cancelled
            super().set_result(result)

    def set_exception(self, exception: BaseException | None) -> None:
        with suppress(InvalidStateError):
            super().set_exception(exception)


def chunk_of(future: CallFuture[R], answer: "Execution") -> "ChunkRecord | None":
    """Let a stream take the answer of its call, unless the call was cancelled."""
    if future.take is None or future.cancelled():
        return None
    return future.take(answer)
