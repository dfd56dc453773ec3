"""A task that takes long to warm up."""

import time

from offboard.common.tasks import task

WARM_S = 3.0


@task("slow_probe", size=lambda: 0.0, warm=lambda: time.sleep(WARM_S))
def slow_probe() -> None:
    """Does nothing."""
