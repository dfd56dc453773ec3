"""Tasks that take no time, or no CPU, so that only the way to the server and back is measured."""

import time
from typing import Any

from offboard.common.tasks import task


@task("nothing", size=lambda: 0.0)
def nothing() -> None:
    pass


@task("length", size=lambda array: array.nbytes)
def length(array: Any) -> int:
    return int(array.nbytes)


@task("wait_20_ms", size=lambda: 0.0)
def wait_20_ms() -> None:
    """As a task that computes on a GPU: it needs its worker, and almost no CPU."""
    time.sleep(0.02)
