"""Calls the function of a task, which may check whether anybody still waits for its answer, and stop.

It may also fork: a copy of the process that it does not end itself ends here.
"""

import os
import sys
import threading
import traceback
from collections.abc import Callable, Iterable
from typing import Any, NoReturn

from offboard.common.errors import Unwanted


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
            _end_copy(sys.exception())


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
