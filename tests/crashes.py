"""Tasks that harm the process in which they run. Robot and server load them as `tests.crashes`."""

import ctypes
import os
import signal
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from offboard.common.task_call import check_wanted
from offboard.common.tasks import task

_hoard: list[NDArray[np.uint8]] = []
_pieces: list[str] = []


@task("segfault", size=lambda: 0.0)
def segfault() -> None:
    ctypes.string_at(0)


@task("leave", size=lambda code: 0.0)  # noqa: ARG005 - all calls have the same size
def leave(code: int) -> None:
    os._exit(code)


@task("leave_a_child", size=lambda seconds: seconds)
def leave_a_child(seconds: float) -> None:
    """Leave a child process behind that keeps the open files of this process."""
    if os.fork() == 0:
        time.sleep(seconds)
        os._exit(0)
    os._exit(4)


@task("kill_itself", size=lambda number: 0.0)  # noqa: ARG005 - all calls have the same size
def kill_itself(number: int) -> None:
    os.kill(os.getpid(), number)


@task("grab", size=lambda byte_count: byte_count)
def grab(byte_count: int) -> int:
    return len(np.ones(byte_count, np.uint8))


@task("hoard", size=lambda byte_count: byte_count)
def hoard(byte_count: int) -> int:
    """Allocate memory and keep it."""
    _hoard.append(np.ones(byte_count, np.uint8))
    return os.getpid()


@task("fill", size=lambda: 0.0)
def fill() -> None:
    """Allocate all memory in small pieces and keep it."""
    while True:
        _pieces.append("piece" * 100 + str(len(_pieces)))


@task("large", size=lambda byte_count: byte_count)
def large(byte_count: int) -> NDArray[np.uint8]:
    return np.zeros(byte_count, np.uint8)


@task("spin", size=lambda begun: 0.0, duplicate=False)  # noqa: ARG005 - all calls have the same size
def spin(begun: str) -> None:
    """Run for ever and ignore signals."""
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    Path(begun).touch()
    while True:
        pass


@task("look", size=lambda begun: 0.0, duplicate=False)  # noqa: ARG005 - all calls have the same size
def look(begun: str) -> None:
    """Run until nobody waits for the answer."""
    Path(begun).touch()
    while True:
        check_wanted()
        time.sleep(0.001)
