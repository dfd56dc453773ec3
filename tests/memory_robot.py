"""A robot that runs as several processes, one after the other, with one memory file."""

from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import pytest

from offboard.common.errors import TaskFailed
from offboard.common.tasks import Task, task
from offboard.robot_client import policies, predictors
from offboard.robot_client.learning.memories import Memories
from offboard.robot_client.learning.store import Store
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.policies import Outlook
from offboard.robot_client.predictors.least_squares import LeastSquares
from offboard.robot_client.records.record import Record
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, Condition, Execution
from tests.fakes import ScriptedRunner
from tests.virtual import VirtualClock

ASKED = 3.0


@task("store_worked", size=lambda size: size, work=lambda result: result["work"])
def store_worked(size: float) -> dict[str, float]:
    return {"work": 10.0 * size}


@task("store_plain", size=lambda size: size)
def store_plain(size: float) -> float:
    return size


class Robot:
    """The robot: its memory file, the Unix time, and sites whose times are drawn from a seed."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "memory.json"
        self.unix_s = 1.7e9
        self.clock = VirtualClock()
        self.random = Random(1)
        self.windows: list[LeastSquares] = []
        self.sites = [self._site(ONBOARD), self._site(CLOUD)]
        self.records: list[Record] = []

    def _site(self, name: str) -> ScriptedRunner:
        def script(one: Task) -> Execution:
            if one.size == ASKED:
                return Execution(name, 0.0, failure=TaskFailed("this size only reads what is known"))
            seconds = 0.1 + 0.05 * one.size * self.random.uniform(0.9, 1.1)
            run_s = (seconds - 0.03) / 2  # behind one task as long as itself; the network takes the rest
            value = one.kind.function(*one.args)
            return Execution(name, seconds, value, queue_s=run_s, run_s=run_s, bytes_out=100, cpu_s=0.01)

        runner = ScriptedRunner(name, script)
        runner.measured = (
            Condition(round_trip_s=0.02, queue=1, server_load=0.2)
            if name != ONBOARD
            else Condition(load=0.4, capacity=0.5)
        )
        return runner

    def started(
        self,
        predictor: str = predictors.LEAST_SQUARES,
        policy: str = "paper",
        window: int = 50,
        **options: Any,
    ) -> Offloader:
        self.windows = []

        def remember() -> predictors.Predictor:
            made = predictors.make(predictor, window)
            if isinstance(made, LeastSquares):
                self.windows.append(made)
            return made

        return Offloader(
            self.sites,
            policy=policies.make(policy, 1),
            memories=Memories(
                remember,
                measured=predictor == predictors.PARTS,
                shared_work=predictor == predictors.PARTS,
                store=Store(self.path, now=lambda: self.unix_s),
            ),
            clock=self.clock,
            observers=[self.records.append],
            **options,
        )

    def ask(self, offload: Offloader, tasks: int, function: Callable[[float], Any] = store_plain) -> None:
        for _ in range(tasks):
            offload(function, self.random.uniform(1, 5), where="both")

    def outlooks(
        self, offload: Offloader, function: Callable[[float], Any] = store_plain
    ) -> dict[str, Outlook]:
        """What is known of the sites now; the task that asks for it fails and teaches nothing."""
        with pytest.raises(TaskFailed):
            offload(function, ASKED, where=ONBOARD)
        return dict(self.records[-1].sites)
