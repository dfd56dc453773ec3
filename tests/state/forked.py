"""A forked child of this process, and what it says."""

import os
import select
import signal
import time
import warnings
from collections.abc import Callable
from typing import Any

from offboard.common.errors import describe

TEXT_MAX = 4000  # less than a pipe holds


def said_by_child(act: Callable[[], Any], within_s: float) -> str:
    """The answer, or the error, of `act` in a forked child. TimeoutError if it says nothing in time."""
    reading, writing = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # Python 3.12 warns, because there are threads
        child = os.fork()
    if child == 0:
        _say(act, writing)
    os.close(writing)
    try:
        return _read(reading, within_s)
    finally:
        os.close(reading)
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)


def _say(act: Callable[[], Any], writing: int) -> None:
    try:
        said = repr(act())
    except BaseException as error:  # noqa: BLE001 - the parent judges it
        said = describe(error)
    os.write(writing, said.encode()[:TEXT_MAX])
    os._exit(0)


def _read(reading: int, within_s: float) -> str:
    end_s, said = time.monotonic() + within_s, b""
    while select.select([reading], [], [], max(0.0, end_s - time.monotonic()))[0]:
        if not (piece := os.read(reading, TEXT_MAX)):
            return said.decode()
        said += piece
    raise TimeoutError(f"the child said nothing for {within_s:g} s")
