"""The other robots of a simulated scenario: they load the server, and always choose the faster site."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from offboard.loadgen.relay.link.link import Link
from offboard.loadgen.simulation.model.simulated_connection import SimulatedConnection
from offboard.loadgen.simulation.model.simulated_cpu import SimulatedCpu
from offboard.loadgen.simulation.model.simulated_direction import Message
from offboard.loadgen.simulation.model.simulated_server import OK, Reply, SimulatedServer
from offboard.loadgen.simulation.model.task_costs import DECIDING_CPU_S
from offboard.loadgen.simulation.model.true_costs import TrueCosts
from offboard.loadgen.simulation.model.virtual_clock import VirtualClock
from offboard.loadgen.simulation.oracle import Coming, Oracle
from offboard.loadgen.simulation.simulated_cloud import TASK
from offboard.robot_client.sites.runner import CLOUD, ONBOARD


@dataclass(frozen=True, slots=True)
class RobotSettings:
    """A robot: its name, its CPU quota, the seed of its link, and the timeout of a cloud run."""

    name: str
    cpus: float
    seed: int
    timeout_s: float


class OtherRobot:
    """Runs its tasks one after the other, each on the site that is really faster, between `begin` and `end`.

    It neither learns nor repeats: a task that the server refuses or loses runs onboard.
    """

    def __init__(
        self,
        settings: RobotSettings,
        clock: VirtualClock,
        server: SimulatedServer,
        costs: TrueCosts,
        link: Link,
    ) -> None:
        self.cpu = SimulatedCpu(clock, settings.cpus)
        self.connection = SimulatedConnection(
            clock, server, link, settings.seed, on_up=lambda: None, on_lost=self._on_lost
        )
        self.coming: Coming | None = None  # its request on the way to the server
        self._name = settings.name
        self._timeout_s = settings.timeout_s
        self._clock = clock
        self._server = server
        self._costs = costs
        self._oracle = Oracle(
            clock=clock,
            connection=self.connection,
            server=server,
            robot=self.cpu,
            costs=costs,
            owner=settings.name,
        )
        self._number = -1  # of the current task
        self._working = self._paused = self._in_cloud = False
        self._held: Callable[[], None] | None = None  # where a paused robot continues

    def begin(self) -> None:
        if not self._working:
            self._working = True
            self._next(self._number)

    def end(self) -> None:
        """Stop working. The server finishes its request, and nobody reads the answer."""
        self._working = self._paused = self._in_cloud = False
        self._held = None
        self._number += 1
        self.cpu.clear()

    def pause(self) -> None:
        self._paused = True
        self.cpu.change(paused=True)

    def resume(self) -> None:
        self._paused = False
        self.cpu.change(paused=False)
        if self._held is not None:
            held, self._held = self._held, None
            held()

    def _next(self, number: int) -> None:
        """Start the task after `number`, unless it was already started."""
        if not self._working or number != self._number:
            return
        if self._paused:
            self._held = partial(self._next, number)
            return
        self._number += 1
        self._in_cloud = False
        self._clock.after(DECIDING_CPU_S / self.cpu.share(1), partial(self._decide, self._number))

    def _decide(self, number: int) -> None:
        if number != self._number:
            return
        if self._paused:
            self._held = partial(self._decide, number)
            return
        cloud_s = self._oracle.cloud_s(number, coming=())
        if cloud_s is not None and cloud_s < self._oracle.onboard_s(number):
            self._send(number)
        else:
            self._run(number)

    def _run(self, number: int) -> None:
        """Run the task onboard."""
        if number == self._number:
            self._in_cloud = False
            cpu_s = self._costs.seconds(ONBOARD, number)
            self.cpu.add(cpu_s, lambda _: self._next(number), owner=self._name)

    def _send(self, number: int) -> None:
        """Run the task in the cloud. The CPU time for packing and unpacking is counted at the end."""
        self._in_cloud = True
        cpu_s, task = self._costs.seconds(CLOUD, number), self._costs.task(number)
        request = Message(task.bytes_out, f"{TASK}1", number)
        arrives_s = self.connection.to_cloud.due_s(request, self._clock.now_s())
        self.coming = None if arrives_s is None else (arrives_s, cpu_s)
        self.connection.send(request, partial(self._arrive, number, cpu_s))
        self._clock.after(self._timeout_s, partial(self._give_up, number))

    def _arrive(self, number: int, cpu_s: float) -> None:
        self.coming = None
        key = (self._name, number)
        self._server.request(key, cpu_s, self._timeout_s, partial(self._reply, number))

    def _reply(self, number: int, reply: Reply) -> None:
        then = self._received if reply.status == OK else self._give_up
        message = Message(self._costs.task(number).bytes_in, f"{TASK}1", number)
        self.connection.reply(message, partial(then, number))

    def _received(self, number: int) -> None:
        sending_s = self._costs.cost.sending_s / self.cpu.share(1)
        self._clock.after(sending_s, partial(self._next, number))

    def _give_up(self, number: int) -> None:
        if self._in_cloud and number == self._number:
            self._server.cancel((self._name, number))
            self._run(number)

    def _on_lost(self) -> None:
        self.coming = None
        self._give_up(self._number)
