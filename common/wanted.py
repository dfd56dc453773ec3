"""Lets a long task check whether anybody still waits for its answer, and stop if nobody does."""

import threading
from collections.abc import Callable, Iterable
from typing import Any

from offboard.common.errors import Unwanted


class _Here(threading.local):
    wanted: Callable[[], bool] | None = None


_here = _Here()


def always() -> bool:
    """For a task whose answer is always wanted."""
    return True


def call_while(wanted: Callable[[], bool], function: Callable[..., Any], args: Iterable[Any]) -> Any:
    """Call the function of a task. `check_wanted` inside it calls `wanted`.

    If another task makes this call, in the same thread, the answer of that task must be wanted too.
    """
    outer = _here.wanted
    _here.wanted = wanted if outer is None else lambda: outer() and wanted()
    try:
        return function(*args)
    finally:
        _here.wanted = outer


def check_wanted() -> None:
    """Raise Unwanted if nobody waits for the answer of this task any more. Let it end the task.

    This happens if the answer is too late or if another site was first. A call takes about 0.2 microseconds.
    Outside a task it does nothing.
    """
    if _here.wanted is not None and not _here.wanted():
        raise Unwanted("nobody waits for the answer any more")
