"""How an offloader ends: by `close`, when it is dropped without it, and in a forked process.

What it does while it lives is in `offloader`.
"""

import os
import threading
import warnings
import weakref
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, TypeVar

from offboard.common.errors import OffloadError
from offboard.robot_client.discovery.present_sites import PresentSites
from offboard.robot_client.execution.call_threads import CallThreads
from offboard.robot_client.learning.memories import Memories
from offboard.robot_client.records.recording import Recording
from offboard.robot_client.sites.onboard import inside_a_task

ASYNC_NAME = "run"
ASYNC_CALLS_MAX = 32  # calls of `submit` and `run` at a time; each has a thread while it waits for its answer
LATE_NAME = "deadline"

T = TypeVar("T")


class Lifetime:
    """What an offloader has opened, until it is closed. It knows nothing of the offloader itself.

    `lock`: that of the offloader. `recording`: its trace and metrics, if it has any. `forked`: this is a
    process that was forked from that of the offloader, and has neither its threads nor its connections.
    """

    def __init__(self, sites: PresentSites, memories: Memories, lock: threading.Lock) -> None:
        self.closed = False
        self.forked = False
        self.recording: Recording | None = None
        self._async_calls = CallThreads(ASYNC_CALLS_MAX, ASYNC_NAME)
        self._late_calls = CallThreads(ASYNC_CALLS_MAX, LATE_NAME)
        self._sites = sites
        self._memories = memories
        self._lock = lock
        _lifetimes.add(self)

    def refuse_in_fork(self) -> None:
        """OffloadError if this is a forked process."""
        if self.forked:
            said = "this process was forked after its offloader was made; make a new one in this process"
            raise OffloadError(said)

    def call_in_thread(self, call: Callable[[], T], future: "Future[T]") -> None:
        """Make a call of `submit` or `run`, for this future."""
        self._start(self._async_calls, call, future)

    def call_beside(self, call: Callable[[], T]) -> "Future[T]":
        """Make a call whose caller may leave at a deadline. That caller may be a call of `submit`."""
        return self._start(self._late_calls, call, None)

    def leave(self, call: "Future[Any]") -> None:
        """Nobody waits for this call of `call_beside` any more; it still runs if there is a thread for it."""
        self._late_calls.drop(call)

    def close_when_dropped(self, offloader: object) -> None:
        """Close, with a ResourceWarning, when nothing refers to the offloader any more."""
        weakref.finalize(offloader, self._dropped).atexit = False

    def close(self) -> None:
        """Close runners, trace and metrics, and save what was learnt. Safe to call twice."""
        if self.forked:
            return
        with self._lock:
            first, self.closed = not self.closed, True
            last = self._memories.snapshot() if first else None
        self._sites.close()
        for calls in (self._async_calls, self._late_calls):
            calls.close(wait=False)
        if last is not None:
            self._memories.save_last(last)
        if self.recording is not None:
            self.recording.close()

    def _start(self, calls: CallThreads, call: Callable[[], T], future: "Future[T] | None") -> "Future[T]":
        """The code of a task gets a thread of its own: the others may all wait for that task."""
        if not inside_a_task():
            return calls.start(call, call=future)
        own = CallThreads(1, ASYNC_NAME)
        try:
            return own.start(call, call=future)
        finally:
            own.close(wait=False)

    def _dropped(self) -> None:
        """Called by any thread at any moment, so that another thread must take the locks."""
        if self.closed or self.forked:
            return
        threading.Thread(target=self.close, name="dropped", daemon=True).start()
        sites = ", ".join(self._sites)
        warnings.warn(f"an offloader was dropped without close(); its sites: {sites}", ResourceWarning, 2)

    def _fork(self) -> None:
        """This is a forked process: everything here belongs to the other one."""
        self.forked = True
        if self.recording is not None:
            self.recording.leave_to_parent()


_lifetimes: "weakref.WeakSet[Lifetime]" = weakref.WeakSet()  # for the hook, which cannot be taken back


def _after_fork() -> None:
    for one in list(_lifetimes):
        one._fork()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)
