"""The simulated runner of the site `onboard`: the computer of the robot, and the load that it measures."""

import math
from concurrent.futures import Future
from functools import partial

from offboard.common.errors import Overtaken
from offboard.common.host.load import EVERY_S, HURRIED_S
from offboard.common.tasks import Kind, Task
from offboard.loadgen.simulation.model.simulated_cpu import Run, SimulatedCpu
from offboard.loadgen.simulation.model.simulated_load import SimulatedLoad
from offboard.loadgen.simulation.model.true_costs import TrueCosts
from offboard.loadgen.simulation.model.virtual_clock import VirtualClock
from offboard.loadgen.testbed.testbed import ROBOT
from offboard.robot_client.sites.runner import NOTHING, ONBOARD, Condition, Execution, Sending


class SimulatedOnboard:
    """Runs one task at a time on the CPU quota of the robot, as `OnboardRunner` does."""

    site = ONBOARD

    def __init__(self, clock: VirtualClock, cpu: SimulatedCpu, costs: TrueCosts) -> None:
        self._clock = clock
        self._cpu = cpu
        self._costs = costs
        self._runs: dict[int, tuple[Run, Future[Execution]]] = {}
        self._load = SimulatedLoad(clock, cpu)

    def unavailable(self, kind: Kind) -> str | None:  # noqa: ARG002 - onboard always exists
        return None

    def submit(self, task: Task, budget_s: float) -> "Future[Execution]":  # noqa: ARG002 - it has no limit
        future: Future[Execution] = Future()
        cpu_s = self._costs.cpu_s(ONBOARD, task)
        run = self._cpu.add(cpu_s, partial(self._ended, task, cpu_s), owner=ROBOT)
        self._runs[task.id] = run, future
        return future

    def to_send(self, task: Task) -> Sending:  # noqa: ARG002 - nothing is sent
        return NOTHING

    def cancel(self, task: Task) -> None:
        """End the run, even if it has begun: the tasks of scenarios check often if they are cancelled."""
        run, future = self._runs.pop(task.id, (None, None))
        if run is not None and future is not None:
            self._cpu.stop(run)
            failure, seconds = Overtaken("another site answered first"), self._clock.now_s() - run.added_s
            started = run.begun_s < math.inf
            future.set_result(Execution(ONBOARD, seconds, failure=failure, censored=True, started=started))

    def hurry(self) -> None:
        self._load.share(HURRIED_S)

    def condition(self) -> Condition:
        return Condition(load=self._load.share(EVERY_S), capacity=self._load.capacity)

    def close(self) -> None:
        pass

    def _ended(self, task: Task, cpu_s: float, run: Run) -> None:
        _, future = self._runs.pop(task.id)
        now_s = self._clock.now_s()
        future.set_result(
            Execution(
                ONBOARD,
                now_s - run.added_s,
                self._costs.value(task),
                queue_s=run.begun_s - run.added_s,
                run_s=now_s - run.begun_s,
                network_s=0.0,
                cpu_s=cpu_s,
            )
        )
