"""One robot's connection to a simulated server: both ways of it, and making it again when it is lost."""

from collections.abc import Callable
from functools import partial

from offboard.loadgen.relay.link.link import Link
from offboard.loadgen.simulation.model.clock import VirtualClock
from offboard.loadgen.simulation.model.costs import HELLO_BYTES
from offboard.loadgen.simulation.model.one_way import Way
from offboard.loadgen.simulation.model.server import Server
from offboard.robot_client.sites.cloud_socket import RECONNECT_MAX_MS, RECONNECT_MS

HANDSHAKE_TRIPS = 2  # round trips of ZMTP (greeting, ready) before hello


class Connection:
    """Up at first. `on_up` and `on_lost` are told of every change; draws by `seed`."""

    def __init__(
        self,
        clock: VirtualClock,
        server: Server,
        link: Link,
        seed: int,
        *,
        on_up: Callable[[], None],
        on_lost: Callable[[], None],
    ) -> None:
        self.up = True
        self.to_cloud = Way(clock, link.up, seed, "up")
        self.to_robot = Way(clock, link.down, seed, "down")
        self._clock = clock
        self._server = server
        self._on_up = on_up
        self._on_lost = on_lost
        self._life = 0
        server.listeners.append(self.lose)

    def say(self, size: int, what: str, number: int, message: Callable[[], object]) -> None:
        """To the server, where `message` happens."""
        self.to_cloud.send(size, what, number, partial(self._server.hear, message))

    def answer(self, size: int, what: str, number: int, arrive: Callable[[], object]) -> None:
        """To the robot."""
        self.to_robot.send(size, what, number, arrive)

    def change(self, link: Link) -> None:
        kept = [self.to_cloud.change(link.up), self.to_robot.change(link.down)]
        if not all(kept):
            self.lose()

    def lose(self) -> None:
        """It breaks, with all that is under way, and is tried again."""
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
        trip_ms = self.to_cloud.conditions.delay_ms + self.to_robot.conditions.delay_ms
        self._clock.after(HANDSHAKE_TRIPS * trip_ms / 1e3, partial(self._say_hello, life))

    def _say_hello(self, life: int) -> None:
        if life == self._life:
            back = partial(self.answer, HELLO_BYTES, "hello", life, self._connected)
            self.say(HELLO_BYTES, "hello", life, back)

    def _connected(self) -> None:
        self.up = True
        self._on_up()
