"""The runners of a robot in virtual time: its own computer, and a server that it talks to.

The conversation with a server is that of a real robot. What its messages are, and how they travel, is up to
`simulated_cloud` and `fleet_servers`.
"""

import math
from concurrent.futures import Future
from functools import partial

from offboard.common.errors import Overtaken
from offboard.common.load import EVERY_S, HURRIED_S
from offboard.common.tasks import Kind, Task
from offboard.loadgen.simulation.model.simulated_cpu import Run, SimulatedCpu, SimulatedLoad
from offboard.loadgen.simulation.model.true_costs import TrueCosts, number_of
from offboard.loadgen.testbed.testbed import ROBOT
from offboard.robot_client.sites.conversation import PendingRequest
from offboard.robot_client.sites.heartbeat import Heartbeat
from offboard.robot_client.sites.runner import NOTHING, ONBOARD, Condition, Execution, Sending
from offboard.testing.virtual_clock import VirtualClock
from offboard.testing.virtual_driver import VirtualDriver


class VirtualSite(VirtualDriver):
    """A server, as one robot uses it, with requests that the robot packs before it sends them.

    - `cpu`: the CPU of the robot, which packs and unpacks the messages.
    """

    def __init__(
        self, clock: VirtualClock, cpu: SimulatedCpu, costs: TrueCosts, *, site: str, heartbeat: Heartbeat
    ) -> None:
        self._cpu = cpu
        self._costs = costs
        super().__init__(clock, site=site, heartbeat=heartbeat)

    def to_send(self, task: Task) -> Sending:
        return Sending(self._costs.task(number_of(task)).bytes_out)

    @property
    def sending_s(self) -> float:
        """How long the robot needs now to pack and send a request, or to receive and unpack a reply."""
        return self._costs.cost.sending_s / 2 / self._cpu.share_of_one_more

    def _send(self, request: PendingRequest) -> None:
        self._clock.after(self.sending_s, partial(self._send_if_wanted, request))

    def _send_packed(self, request: PendingRequest) -> None:
        """Send a request, which has been packed."""
        raise NotImplementedError

    def _send_if_wanted(self, request: PendingRequest) -> None:
        if not request.future.done():
            self._send_packed(request)

    def _unpacked(
        self, request: PendingRequest, *, queue_s: float, run_s: float, cpu_s: float, bytes_in: int
    ) -> None:
        """The robot has unpacked the answer to a request."""
        seconds = self._clock.now_s() - request.published_s
        execution = Execution(
            self.site,
            seconds,
            self._costs.value(request.task),
            queue_s=queue_s,
            run_s=run_s,
            network_s=max(0.0, seconds - queue_s - run_s),
            cpu_s=cpu_s,
            bytes_out=request.bytes_out,
            bytes_in=bytes_in,
        )
        self._answered(request, execution)


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
