"""Whether somebody still waits for the task that runs in this thread: a long one may look, and stop."""

import threading
from collections.abc import Callable, Iterable
from typing import Any

from offboard.common.errors import Unwanted


class _Here(threading.local):
    wanted: Callable[[], bool] | None = None


_here = _Here()


def always() -> bool:
    """Of a task that is wanted to its end."""
    return True


def call_while(wanted: Callable[[], bool], function: Callable[..., Any], args: Iterable[Any]) -> Any:
    """Call a task's function; `check_wanted` in it asks `wanted`."""
    _here.wanted = wanted
    try:
        return function(*args)
    finally:
        _here.wanted = None


def check_wanted() -> None:
    """Unwanted, for the task to end with, where its answer was given up: late, or another site was first.

    It costs a fifth of a microsecond; where nobody can tell, the answer is wanted.
    """
    if _here.wanted is not None and not _here.wanted():
        raise Unwanted("nobody waits for the answer any more")
