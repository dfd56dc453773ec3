"""The other robots of a simulated scenario: background load on the server, by a rule that knows all times."""

from collections.abc import Callable
from functools import partial

from offboard.loadgen.relay.link.link import Link
from offboard.loadgen.simulation import oracle as foresight
from offboard.loadgen.simulation.cloud import TASK
from offboard.loadgen.simulation.model.clock import VirtualClock
from offboard.loadgen.simulation.model.costs import DECIDING_CPU_S
from offboard.loadgen.simulation.model.processor import Processor
from offboard.loadgen.simulation.model.robot_connection import Connection
from offboard.loadgen.simulation.model.server import OK, Reply, Server
from offboard.loadgen.simulation.model.true_costs import Truth
from offboard.loadgen.simulation.oracle import Coming
from offboard.robot_client.sites.runner import CLOUD, ONBOARD


class OtherRobot:
    """Asks for its tasks one after the other, each where it would truly be done first, until it is ended.

    It learns and repeats nothing: what the server refuses or loses it does onboard.
    """

    def __init__(
        self,
        name: str,
        clock: VirtualClock,
        server: Server,
        cpus: float,
        truth: Truth,
        link: Link,
        seed: int,
        timeout_s: float,
    ) -> None:
        self.processor = Processor(clock, cpus)
        self.connection = Connection(clock, server, link, seed, on_up=lambda: None, on_lost=self._on_lost)
        self.coming: Coming | None = None  # its request that is on its way
        self._name = name
        self._clock = clock
        self._server = server
        self._truth = truth
        self._timeout_s = timeout_s
        self._number = -1  # of the present task
        self._asks = self._paused = self._in_cloud = False
        self._held: Callable[[], None] | None = None  # what a paused robot goes on with

    def begin(self) -> None:
        if not self._asks:
            self._asks = True
            self._next(self._number)

    def end(self) -> None:
        """What it has at the server is done for nobody."""
        self._asks = self._paused = self._in_cloud = False
        self._held = None
        self._number += 1
        self.processor.clear()

    def pause(self, paused: bool) -> None:
        self._paused = paused
        self.processor.change(paused=paused)
        if self._held is not None and not paused:
            held, self._held = self._held, None
            held()

    def _next(self, number: int) -> None:
        """The task after this one, unless another has followed it already."""
        if not self._asks or number != self._number:
            return
        if self._paused:
            self._held = partial(self._next, number)
            return
        self._number += 1
        self._in_cloud = False
        self._clock.after(DECIDING_CPU_S / self.processor.share(1), partial(self._ask, self._number))

    def _ask(self, number: int) -> None:
        if number != self._number:
            return
        if self._paused:
            self._held = partial(self._ask, number)
            return
        found = foresight.cloud_s(
            self._clock, self.connection, self._server, self.processor, self._truth, number,
            coming=(), without=self._name,
        )  # fmt: skip
        if found is not None and found < foresight.onboard_s(self.processor, self._truth, number):
            self._send(number)
        else:
            self._run(number)

    def _run(self, number: int) -> None:
        """Onboard, whatever became of it in the cloud."""
        if number == self._number:
            self._in_cloud = False
            cpu_s = self._truth.seconds(ONBOARD, number)
            self.processor.add(cpu_s, lambda _: self._next(number), owner=self._name)

    def _send(self, number: int) -> None:
        """Packing and unpacking are counted at its end."""
        self._in_cloud = True
        cpu_s, asked = self._truth.seconds(CLOUD, number), self._truth.asked(number)
        arrives_s = self.connection.to_cloud.due_s(asked.bytes_out, f"{TASK}1", number, self._clock.now_s())
        self.coming = None if arrives_s is None else (arrives_s, cpu_s)
        self.connection.say(asked.bytes_out, f"{TASK}1", number, partial(self._arrive, number, cpu_s))
        self._clock.after(self._timeout_s, partial(self._give_up, number))

    def _arrive(self, number: int, cpu_s: float) -> None:
        self.coming = None
        key = (self._name, number)
        self._server.request(key, cpu_s, self._timeout_s, partial(self._answer, number))

    def _answer(self, number: int, reply: Reply) -> None:
        then = self._received if reply.status == OK else self._give_up
        self.connection.answer(self._truth.asked(number).bytes_in, f"{TASK}1", number, partial(then, number))

    def _received(self, number: int) -> None:
        sending_s = self._truth.cost.sending_s / self.processor.share(1)
        self._clock.after(sending_s, partial(self._next, number))

    def _give_up(self, number: int) -> None:
        if self._in_cloud and number == self._number:
            self._server.cancel((self._name, number))
            self._run(number)

    def _on_lost(self) -> None:
        self.coming = None
        self._give_up(self._number)
