"""The tasks of the state machine. Robot and server load them; `server` also serves a copy with other source.

In the copy every answer is wrong, so an answer of that server is noticed.
"""

import asyncio
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard import Offloader, task

robot: list[Offloader] = []  # what nested calls use; a server has none


@dataclass(frozen=True)
class Point:
    x: float
    y: float


class Mute(Exception):
    def __str__(self) -> str:
        raise RuntimeError("no text")


FAILURES: dict[str, type[BaseException]] = {
    "error": ValueError,
    "exit": SystemExit,
    "interrupt": KeyboardInterrupt,
    "cancel": asyncio.CancelledError,
    "mute": Mute,
}


@task("state_twice", size=lambda number: number)
def twice(number: int) -> int:
    time.sleep(number % 10 / 1000)
    return 2 * number


@task("state_nap", size=lambda seconds: seconds)
def nap(seconds: float) -> float:
    time.sleep(seconds)
    return seconds


@task("state_same", size=lambda value: 0.0, types=(Point,))  # noqa: ARG005 - no size
def same(value: Any) -> Any:
    return value


@task("state_weigh", size=lambda array: array.size)
def weigh(array: NDArray[np.int64]) -> int:
    return int(array.sum())


@task("state_fail", size=lambda how: 0.0)  # noqa: ARG005 - no size
def fail(how: str) -> None:
    if how in FAILURES:
        raise FAILURES[how](how)
    return None  # noqa: RET501 - changed in the copy


@task("state_nested", size=lambda number, depth, batch: depth)  # noqa: ARG005 - one size
def nested(number: int, depth: int, batch: bool) -> int:
    """2 * number + depth. On the robot, each level asks the offloader again, one call or a batch of two."""
    if not depth:
        return 2 * number
    inner = (number, depth - 1, batch)
    for offload in robot:
        return (offload.map(nested, [inner, inner])[1] if batch else offload(nested, *inner)) + 1
    return nested(*inner) + 1


@task("state_scaled", size=lambda number, depth: depth, setup=lambda: 2)  # noqa: ARG005 - one size
def scaled(engine: int, number: int, depth: int) -> int:
    """As `nested`, with a setup: the state of the outer call is in use when the inner one needs it."""
    for offload in robot if depth else ():
        return offload(scaled, number, depth - 1) + 1
    return engine * number + depth


@task("state_once", size=lambda path, number: 0.0, duplicate=False)  # noqa: ARG005 - no size
def once(path: str, number: int) -> int:
    """Leaves a line in a file, which shows how often it ran."""
    with open(path, "a") as file:  # noqa: PTH123 - a path from the wire is text
        file.write(f"{number}\n")
    return number
