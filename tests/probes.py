"""Small tasks for tests. Robot and server load them as `tests.probes`."""

import os
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from offboard.common.tasks import task


@task("echo", size=lambda value=None: 0.0)  # noqa: ARG005 - an empty task has no size
def echo(value: object = None) -> object:
    return value


@task("swallow", size=lambda _: 0.0)
def swallow(_: object) -> None:
    """Takes anything and returns nothing."""


@task("nap", size=lambda seconds: seconds)
def nap(seconds: float) -> float:
    time.sleep(seconds)
    return seconds


@task("burn", size=lambda seconds: seconds)
def burn(seconds: float) -> list[float]:
    """Compute until the thread has used this CPU time; return the seconds used, and those without a CPU."""
    start_s, waited_s = time.thread_time(), _waited_s()
    while (used_s := time.thread_time() - start_s) < seconds:
        pass
    return [used_s, _waited_s() - waited_s]


def _waited_s() -> float:
    """How long this thread was ready to run and had no CPU, as the kernel counts it."""
    return int(Path("/proc/thread-self/schedstat").read_text().split()[1]) / 1e9


@task("total", size=lambda numbers: float(len(numbers)))
def total(numbers: NDArray[np.float64]) -> float:
    return float(numbers.sum())


@task("zeros", size=lambda count: count)
def zeros(count: int) -> NDArray[np.uint8]:
    return np.zeros(count, np.uint8)


@task("process_id", size=lambda: 0.0)
def process_id() -> int:
    return os.getpid()


@task("mark_once", size=lambda path: 0.0, duplicate=False)  # noqa: ARG005 - no size
def mark_once(path: str) -> int:
    """Append the process id to a file, which shows how often the task ran."""
    with open(path, "a") as file:  # noqa: PTH123 - a path from the wire is text
        file.write(f"{os.getpid()}\n")
    return os.getpid()
