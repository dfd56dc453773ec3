"""The other robots of a simulated scenario: they load the servers, and always choose the fastest site."""

from collections.abc import Callable, Mapping
from functools import partial

from offboard.loadgen.relay.link.link import Link
from offboard.loadgen.simulation.model.simulated_connection import TASK, Message, SimulatedConnection
from offboard.loadgen.simulation.model.simulated_cpu import SimulatedCpu
from offboard.loadgen.simulation.model.simulated_server import OK, Reply, SimulatedServer
from offboard.loadgen.simulation.model.task_costs import DECIDING_CPU_S
from offboard.loadgen.simulation.model.true_costs import Coming, Oracle, TrueCosts
from offboard.robot_client.sites.runner import CLOUD, ONBOARD
from offboard.testing.virtual_clock import VirtualClock


class OtherRobot:
    """Runs tasks one after the other, each on the site that is really fastest, between `start` and `kill`.

    It neither learns nor repeats: a task that the server refuses or loses runs onboard.
    """

    def __init__(
        self,
        clock: VirtualClock,
        servers: Mapping[str, SimulatedServer],
        costs: TrueCosts,
        links: Mapping[str, Link],
        *,
        name: str,
        cpus: float,
        seed: int,
        timeout_s: float,
    ) -> None:
        self.cpu = SimulatedCpu(clock, cpus)
        self.connections = {
            at: SimulatedConnection(
                clock, server, links[at], seed + n, on_up=lambda: None, on_lost=partial(self._on_lost, at)
            )
            for n, (at, server) in enumerate(servers.items())
        }
        self._coming: Coming | None = None  # its request on the way to a server
        self._name = name
        self._timeout_s = timeout_s
        self._clock = clock
        self._servers = servers
        self._costs = costs
        self._oracle = Oracle(clock, self.cpu, costs, name)
        self._number = -1  # of the current task
        self._working = self._paused = False
        self._used: str | None = None  # the server that runs the current task
        self._held: Callable[[], None] | None = None  # where a paused robot continues

    def coming_to(self, server: str) -> Coming | None:
        """Its request on the way to this server."""
        return self._coming if self._used == server else None

    def start(self) -> None:
        if not self._working:
            self._working = True
            self._next(self._number)

    def kill(self) -> None:
        """Stop working. The server finishes its request, and nobody reads the answer."""
        self._working = self._paused = False
        self._used = None
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
        self._used = None
        self._clock.after(DECIDING_CPU_S / self.cpu.share(1), partial(self._decide, self._number))

    def _decide(self, number: int) -> None:
        if number != self._number:
            return
        if self._paused:
            self._held = partial(self._decide, number)
            return
        times = {name: self._oracle.cloud_s(number, line) for name, line in self.connections.items()}
        fastest = min(times, key=times.__getitem__)
        if times[fastest] < self._oracle.onboard_s(number):
            self._send(fastest, number)
        else:
            self._run(number)

    def _run(self, number: int) -> None:
        """Run the task onboard."""
        if number == self._number:
            self._used = None
            cpu_s = self._costs.seconds(ONBOARD, number)
            self.cpu.add(cpu_s, lambda _: self._next(number), owner=self._name)

    def _send(self, server: str, number: int) -> None:
        """Run the task on a server. The CPU time for packing and unpacking is counted at the end."""
        self._used, connection = server, self.connections[server]
        cpu_s, task = self._costs.seconds(CLOUD, number), self._costs.task(number)
        request = Message(task.bytes_out, f"{TASK}1", number)
        self._coming = connection.to_cloud.due_s(request, self._clock.now_s()), cpu_s
        connection.send(request, partial(self._arrive, server, number, cpu_s))
        self._clock.after(self._timeout_s, partial(self._give_up, number))

    def _arrive(self, server: str, number: int, cpu_s: float) -> None:
        self._coming = None
        key, answer = (self._name, number), partial(self._reply, server, number)
        self._servers[server].request(key, cpu_s, self._timeout_s, answer)

    def _reply(self, server: str, number: int, reply: Reply) -> None:
        then = self._received if reply.status == OK else self._give_up
        message = Message(self._costs.task(number).bytes_in, f"{TASK}1", number)
        self.connections[server].to_robot.send(message, partial(then, number))

    def _received(self, number: int) -> None:
        sending_s = self._costs.cost.sending_s / self.cpu.share(1)
        self._clock.after(sending_s, partial(self._next, number))

    def _give_up(self, number: int) -> None:
        if self._used is not None and number == self._number:
            self._servers[self._used].cancel((self._name, number))
            self._run(number)

    def _on_lost(self, server: str) -> None:
        if self._used == server:
            self._coming = None
            self._give_up(self._number)
