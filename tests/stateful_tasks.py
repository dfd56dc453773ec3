"""A task with a setup, for tests. Robot and server load it as `tests.stateful_tasks`."""

import os
import threading
import time

from offboard.common.tasks import task

SETUP_S = 0.05


class Engine:
    """Fails if two tasks use it at the same time, and counts the engines of this process."""

    made = 0

    def __init__(self) -> None:
        if "BREAK_ENGINE" in os.environ:
            raise RuntimeError("no engine")
        time.sleep(SETUP_S)
        Engine.made += 1
        self.number = Engine.made
        self._busy = threading.Lock()

    def twice(self, number: int) -> int:
        assert self._busy.acquire(blocking=False), "two tasks use one engine"
        time.sleep(0.002)
        self._busy.release()
        return 2 * number


@task("engine_twice", size=lambda number, scale=1: number * scale, setup=Engine)
def engine_twice(engine: Engine, number: int, scale: int = 1) -> list[int]:
    """Twice the number, the process, the engine that was used, and how many engines the process has."""
    return [engine.twice(number) * scale, os.getpid(), engine.number, Engine.made]
