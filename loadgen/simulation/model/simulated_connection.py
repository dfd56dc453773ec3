"""The connection of a robot to the simulated server: both directions, losses and reconnects."""

from collections.abc import Callable
from functools import partial

from offboard.loadgen.relay.link.link import Link
from offboard.loadgen.simulation.model.simulated_direction import Message, SimulatedDirection
from offboard.loadgen.simulation.model.simulated_server import SimulatedServer
from offboard.loadgen.simulation.model.task_costs import HELLO_BYTES
from offboard.loadgen.simulation.model.virtual_clock import VirtualClock
from offboard.robot_client.sites.cloud_socket import RECONNECT_MAX_MS, RECONNECT_MS

HANDSHAKE_TRIPS = 2  # round trips of ZMTP (greeting, ready) before hello


class SimulatedConnection:
    """A connection that is up at first; `on_up` and `on_lost` are called when that changes.

    `seed` is that of the random draws of the link.
    """

    def __init__(
        self,
        clock: VirtualClock,
        server: SimulatedServer,
        link: Link,
        seed: int,
        *,
        on_up: Callable[[], None],
        on_lost: Callable[[], None],
    ) -> None:
        self.up = True
        self.to_cloud = SimulatedDirection(clock, link.up, seed, "up")
        self.to_robot = SimulatedDirection(clock, link.down, seed, "down")
        self._clock = clock
        self._server = server
        self._on_up = on_up
        self._on_lost = on_lost
        self._life = 0
        server.listeners.append(self.lose)

    def send(self, message: Message, arrive: Callable[[], object]) -> None:
        """Send a message to the server, which then calls `arrive`."""
        self.to_cloud.send(message, partial(self._server.receive, arrive))

    def reply(self, message: Message, arrive: Callable[[], object]) -> None:
        """Send a message to the robot; `arrive` is called when it is there."""
        self.to_robot.send(message, arrive)

    def change(self, link: Link) -> None:
        kept = [self.to_cloud.change(link.up), self.to_robot.change(link.down)]
        if not all(kept):
            self.lose()

    def lose(self) -> None:
        """The connection breaks, with all messages on their way, and is tried again after a pause."""
        self.up = False
        self._life += 1
        self.to_cloud.lose()
        self.to_robot.lose()
        self._on_lost()
        self._clock.after(RECONNECT_MS / 1e3, partial(self._try, RECONNECT_MS, self._life))

    def _try(self, pause_ms: float, life: int) -> None:
        if life != self._life:
            return
        if not self._server.up:
            pause_ms = min(2 * pause_ms, RECONNECT_MAX_MS)
            self._clock.after(pause_ms / 1e3, partial(self._try, pause_ms, life))
            return
        trip_ms = self.to_cloud.delay_ms() + self.to_robot.delay_ms()
        self._clock.after(HANDSHAKE_TRIPS * trip_ms / 1e3, partial(self._say_hello, life))

    def _say_hello(self, life: int) -> None:
        if life == self._life:
            hello = Message(HELLO_BYTES, "hello", life)
            self.send(hello, partial(self.reply, hello, self._connected))

    def _connected(self) -> None:
        self.up = True
        self._on_up()
