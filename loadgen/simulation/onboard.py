"""The runner of the robot's own computer in a simulation, and what it measures of its load."""

import math
from concurrent.futures import Future
from functools import partial

from offboard.common.errors import Overtaken
from offboard.common.host.load import EVERY_S, HURRIED_S, LOADED
from offboard.common.tasks import Kind, Task
from offboard.loadgen.simulation.model.clock import VirtualClock
from offboard.loadgen.simulation.model.measured_load import SimulatedLoad
from offboard.loadgen.simulation.model.processor import Processor, Run
from offboard.loadgen.simulation.model.true_costs import Truth
from offboard.loadgen.testbed.testbed import ROBOT
from offboard.robot_client.sites.own_cpu import OwnCpu
from offboard.robot_client.sites.runner import ONBOARD, Condition, Execution


class SimulatedOnboard:
    """One task at a time on the robot's quota, as `OnboardRunner`."""

    site = ONBOARD

    def __init__(self, clock: VirtualClock, processor: Processor, truth: Truth) -> None:
        self._clock = clock
        self._processor = processor
        self._truth = truth
        self._runs: dict[int, tuple[Run, Future[Execution]]] = {}
        self._load = SimulatedLoad(clock, processor)
        self.own_cpu = OwnCpu()

    def unavailable(self, kind: Kind) -> str | None:  # noqa: ARG002 - onboard always exists
        return None

    def submit(self, task: Task, budget_s: float) -> "Future[Execution]":  # noqa: ARG002 - not to be stopped
        future: Future[Execution] = Future()
        cpu_s = self._truth.cpu_s(ONBOARD, task)
        run = self._processor.add(cpu_s, partial(self._ended, task, cpu_s), owner=ROBOT)
        self._runs[task.id] = run, future
        self.own_cpu.begin()
        return future

    def cancel(self, task: Task) -> None:
        """The tasks of scenarios look often whether they are wanted: one that runs ends now too."""
        run, future = self._runs.pop(task.id, (None, None))
        if run is not None and future is not None:
            self._processor.stop(run)
            self.own_cpu.end(self._clock.now_s())
            failure, seconds = Overtaken("another site answered first"), self._clock.now_s() - run.added_s
            started = run.begun_s < math.inf
            future.set_result(Execution(ONBOARD, seconds, failure=failure, censored=True, started=started))

    def hurry(self) -> None:
        self._load.share(HURRIED_S)

    def condition(self) -> Condition:
        load = self._load.share(self.own_cpu.pause_s(EVERY_S))
        self.own_cpu.loaded = load > LOADED
        return Condition(load=load, capacity=self._load.capacity)

    def close(self) -> None:
        pass

    def _ended(self, task: Task, cpu_s: float, run: Run) -> None:
        _, future = self._runs.pop(task.id)
        now_s = self._clock.now_s()
        self.own_cpu.end(now_s)
        future.set_result(
            Execution(
                ONBOARD,
                now_s - run.added_s,
                self._truth.value(task),
                queue_s=run.begun_s - run.added_s,
                run_s=now_s - run.begun_s,
                network_s=0.0,
                cpu_s=cpu_s,
            )
        )
