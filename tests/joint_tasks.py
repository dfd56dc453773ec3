"""Tasks that run together on a server. Robot and server load them as `tests.joint_tasks`."""

import os
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard import Together, task

NAP_S = 0.002
POISON = -1.0
DEADLY = -2.0


def doubled(inputs: list[float]) -> list[float]:
    time.sleep(NAP_S)
    if POISON in inputs:
        raise ValueError("poisoned")
    if DEADLY in inputs and "JOINT_DEADLY" in os.environ:  # on a server, not on the robot of the test
        os.kill(os.getpid(), signal.SIGSEGV)
    return [2.0 * one for one in inputs]


@task("joint_double", size=lambda _: 1.0, together=Together(doubled, at_most=8, wait_s=0.02))
def joint_double(one: float) -> float:
    return doubled([one])[0]


def counted(inputs: list[tuple[float, str]]) -> list[int]:
    time.sleep(10 * NAP_S)
    return [len(inputs)] * len(inputs)


@task("joint_count", size=lambda *_: 1.0, together=Together(counted, at_most=4, wait_s=0.5))
def joint_count(one: float, name: str = "a") -> int:  # noqa: ARG001 - it counts the inputs
    """How many inputs ran together."""
    return 1


def noted(inputs: list[str]) -> list[int]:
    for one in inputs:
        with Path(one).open("a") as file:
            file.write("run\n")
    raise ValueError("after the work")


@task("joint_once", size=lambda _: 1.0, duplicate=False, together=Together(noted, at_most=4, wait_s=0.5))
def joint_once(path: str) -> int:
    """Notes its runs in a file, and raises."""
    return noted([path])[0]


@task("joint_short", size=lambda _: 1.0, together=Together(lambda inputs: inputs[1:], at_most=4, wait_s=0.5))
def joint_short(one: float) -> float:
    """Together it returns one result too few."""
    return one


def stacked(state: list[int], inputs: list[NDArray[np.float64]]) -> list[float]:
    state[0] += 1
    return [float(one) for one in np.stack(inputs).sum(axis=1)]  # raises for different shapes


@task(
    "joint_key",
    size=len,
    setup=lambda: [0],
    together=Together(stacked, at_most=4, wait_s=0.2, key=len),
)
def joint_key(state: Any, array: NDArray[np.float64]) -> float:
    return stacked(state, [array])[0]
