"""A task that does what a test says, and offloaders that run it."""

import threading
from collections.abc import Callable, Sequence
from typing import Any

from offboard.common.tasks import task
from offboard.robot_client.learning.memories import Memories
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.policies.baselines import Paper
from offboard.robot_client.predictors import LEAST_SQUARES, make
from offboard.robot_client.records.record import Record
from offboard.robot_client.sites.runner import Runner


def offloader(*runners: Runner, observers: Sequence[Callable[[Record], None]] = ()) -> Offloader:
    return Offloader(
        runners, policy=Paper(), memories=Memories(lambda: make(LEAST_SQUARES, 5)), observers=list(observers)
    )


class Script:
    """What the task `scripted` does with each number; `asked` are its numbers.

    `most` is the largest number of calls that ran at the same time.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.reset()

    def reset(self) -> None:
        self.act: Callable[[int], Any] = lambda number: number
        self.most = 0
        self.asked: list[int] = []
        self._now = 0

    def run(self, number: int) -> Any:
        with self._lock:
            self._now += 1
            self.most = max(self.most, self._now)
            self.asked.append(number)
        try:
            return self.act(number)
        finally:
            with self._lock:
                self._now -= 1


script = Script()


@task("scripted", size=lambda number: number)
def scripted(number: int) -> Any:
    return script.run(number)
