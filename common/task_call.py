"""Calls the function of a task: whether its answer is still wanted, its traceback, and ending its threads.

The function may also fork: a copy of the process that it does not end itself ends here.
"""

import os
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterable
from typing import Any, NoReturn

from offboard.common.errors import Unwanted, is_interrupt

TRACEBACK_LENGTH_MAX = 4000


class _Here(threading.local):
    wanted: Callable[[], bool] | None = None


_here = _Here()


def always() -> bool:
    """For a task whose answer is always wanted."""
    return True


def call_while(wanted: Callable[[], bool], function: Callable[..., Any], args: Iterable[Any]) -> Any:
    """Call the function of a task. `check_wanted` inside it calls `wanted`.

    If another task makes this call, in the same thread, the answer of that task must be wanted too. If the
    function forks, the call returns only in the process that made it.
    """
    process, outer = os.getpid(), _here.wanted
    _here.wanted = wanted if outer is None else lambda: outer() and wanted()
    try:
        return function(*args)
    finally:
        _here.wanted = outer
        if os.getpid() != process:
            _end_copy(sys.exc_info()[1])


def _end_copy(error: BaseException | None) -> NoReturn:
    """End a forked process in which a task returned or raised; it would go on as a second server or robot.

    It has no other thread, and the locks, sockets and buffers of the others, so nothing is torn down.
    """
    if isinstance(error, SystemExit) and (error.code is None or isinstance(error.code, int)):
        os._exit((error.code or 0) & 0xFF)
    if error is not None:
        traceback.print_exception(error)
    os._exit(error is not None)


def check_wanted() -> None:
    """Raise Unwanted if nobody waits for the answer of this task any more. Let it end the task.

    This happens if the answer is too late or if another site was first. A call takes about 0.2 microseconds.
    Outside a task it does nothing.
    """
    if _here.wanted is not None and not _here.wanted():
        raise Unwanted("nobody waits for the answer any more")


def traceback_of(error: BaseException, caller: Callable[..., Any] = call_while) -> str:
    """The traceback below the frame of `caller`; empty if the error was not raised there."""
    frame = error.__traceback__
    while frame is not None and frame.tb_frame.f_code is not caller.__code__:
        frame = frame.tb_next
    if frame is None:
        return ""
    try:
        return bounded("".join(traceback.format_exception(type(error), error, frame.tb_next)))
    except BaseException as unreadable:  # a user's exception may break anything
        if is_interrupt(unreadable):
            raise
        return ""


def bounded(text: str) -> str:
    """The end of a long text: the last lines of a traceback say most."""
    return text if len(text) <= TRACEBACK_LENGTH_MAX else "..." + text[3 - TRACEBACK_LENGTH_MAX :]


def join_all(threads: Iterable[threading.Thread], timeout_s: float) -> int:
    """Wait until these threads have ended, for at most `timeout_s` in total; returns how many still run.

    The calling thread is skipped. A thread that ends at the same time as the process can crash it: OpenSSL
    3.0 then frees the data of the thread twice, and glibc aborts the process. A thread that still runs native
    code can crash it too, because the library that it uses is taken down under it.
    """
    others = [thread for thread in threads if thread is not threading.current_thread()]
    until_s = time.monotonic() + timeout_s
    for thread in others:
        thread.join(max(0.0, until_s - time.monotonic()))
    return sum(thread.is_alive() for thread in others)
