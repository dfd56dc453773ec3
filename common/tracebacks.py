"""Turns the traceback of a failed task into a text of bounded length, for `TaskFailed` and the log.

Who gets the text is decided by those who run tasks.
"""

import traceback
from collections.abc import Callable
from typing import Any

from offboard.common.errors import is_interrupt
from offboard.common.wanted import call_while

TRACEBACK_LENGTH_MAX = 4000


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
