"""Threads that make calls: those of a batch, and those of calls in asyncio.

What a call does is left to those who start it.
"""

import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextvars import copy_context
from functools import partial
from typing import Any, TypeVar

T = TypeVar("T")


class CallThreads:
    """Makes at most `width` calls at a time; further ones wait. Each sees the context of its caller.

    If the system has no thread left at this moment, a call is made in the thread of its caller.
    """

    def __init__(self, width: int, name: str) -> None:
        self._pool = ThreadPoolExecutor(width, thread_name_prefix=name)
        self._width = width
        self._lock = threading.Lock()
        self._unended = 0

    def start(self, function: Callable[..., T], *args: Any, call: "Future[T] | None" = None) -> "Future[T]":
        """Make a call in a thread; returns `call`, or a new future if that is None."""
        call = Future() if call is None else call
        with self._lock:
            self._unended += 1
        call.add_done_callback(self._end)
        todo: list[Callable[[], T]] = [partial(copy_context().run, function, *args)]
        try:
            self._pool.submit(_make, todo, call)
        except RuntimeError:  # the pool may still run what it could not start a thread for
            _make(todo, call)
        return call

    def drop(self, call: "Future[Any]") -> None:
        """Cancel a call that waits for a thread, but not one whose own thread has not begun yet."""
        if self._unended > self._width:
            call.cancel()

    def _end(self, _: "Future[Any]") -> None:
        with self._lock:
            self._unended -= 1

    def close(self, *, wait: bool) -> None:
        """End the threads once they have made the calls that were started."""
        self._pool.shutdown(wait=wait)


def _make(todo: list[Callable[[], T]], call: "Future[T]") -> None:
    """Make a call, unless another thread has taken it, or it was cancelled while it waited."""
    try:
        make = todo.pop()
    except IndexError:
        return
    if call.set_running_or_notify_cancel():
        try:
            call.set_result(make())
        except BaseException as error:  # noqa: BLE001 - for the thread that waits for the call
            call.set_exception(error)
