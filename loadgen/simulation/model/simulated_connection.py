"""The connection of a robot to the simulated server: both directions, losses and reconnects.

What the link does to a message is computed by the link model of the relay.
"""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from offboard.loadgen.relay.link.link import Link, LinkConditions
from offboard.loadgen.relay.link.pipe import Pipe
from offboard.loadgen.simulation.model.simulated_server import SimulatedServer
from offboard.loadgen.simulation.model.task_costs import HELLO_BYTES
from offboard.robot_client.cloud.cloud_socket import RECONNECT_MAX_MS, RECONNECT_MS
from offboard.testing.virtual_clock import VirtualClock

TASK = "task"  # sort of the messages that hold a task or its answer, with the number of the attempt
HELD_MAX = 100_000  # messages that an outage holds; further messages are lost, as with full buffers
HANDSHAKE_TRIPS = 2  # round trips of ZMTP (greeting, ready) before hello


@dataclass(frozen=True, slots=True)
class Message:
    """A message on the link. `what` is its sort, and `number` tells apart the messages of one sort."""

    size: int
    what: str
    number: int


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
        self.server = server
        self._on_up = on_up
        self._on_lost = on_lost
        self._life = 0
        server.listeners.append(self.lose)

    def send(self, message: Message, arrive: Callable[[], object]) -> None:
        """Send a message to the server, which then calls `arrive`."""
        self.to_cloud.send(message, partial(self.server.receive, arrive))

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
        if not self.server.up:
            pause_ms = min(2 * pause_ms, RECONNECT_MAX_MS)
            self._clock.after(pause_ms / 1e3, partial(self._try, pause_ms, life))
            return
        trip_ms = self.to_cloud.delay_ms() + self.to_robot.delay_ms()
        self._clock.after(HANDSHAKE_TRIPS * trip_ms / 1e3, partial(self._say_hello, life))

    def _say_hello(self, life: int) -> None:
        if life == self._life:
            hello = Message(HELLO_BYTES, "hello", life)
            self.send(hello, partial(self.to_robot.send, hello, self._connected))

    def _connected(self) -> None:
        self.up = True
        self._on_up()


class SimulatedDirection:
    """Carries messages of one direction in order.

    A message has its own random draws, which follow from `seed`, `name` and the message. So the same task has
    the same delay and loss, whatever was sent before it. Therefore consecutive messages have no correlated
    jitter and no bursts of loss.
    """

    def __init__(self, clock: VirtualClock, conditions: LinkConditions, seed: int, name: str) -> None:
        self._clock = clock
        self._conditions = conditions
        self._seed = seed
        self._name = name
        self._connection = 0
        self._free_s = self._last_due_s = 0.0
        self._held: deque[Callable[[], object]] = deque()
        self._swallowed = False

    def send(self, message: Message, arrive: Callable[[], object]) -> None:
        """Call `arrive` when the last byte of the message comes out."""
        pipe = self._pipe(message)
        due_s = pipe.due(max(self._clock.now_s(), self._free_s), message.size)
        self._last_due_s = max(self._last_due_s, due_s)
        self._free_s = pipe.busy_until_s
        self._clock.at(self._last_due_s, partial(self._come_out, arrive, self._connection))

    def due_s(self, message: Message, sent_s: float) -> float:
        """When this message would come out if the link were idle and did not change; infinite means never."""
        if self._conditions.outage or self._conditions.hang:
            return math.inf
        return self._pipe(message).due(sent_s, message.size)

    def delay_ms(self) -> float:
        """The delay of a message that enters now, without jitter."""
        return self._conditions.delay_at_ms(self._clock.now_s())

    def change(self, conditions: LinkConditions) -> bool:
        """Change the conditions, and return whether the connection survives.

        It does not survive the end of a hang that took messages.
        """
        self._conditions = conditions
        if self._swallowed and not conditions.hang:
            return False
        while self._held and not conditions.outage:
            self._held.popleft()()
        return True

    def lose(self) -> None:
        """The connection breaks, and all messages on their way are lost."""
        self._connection += 1
        self._held.clear()
        self._swallowed = False
        self._free_s = self._last_due_s = self._clock.now_s()

    def _pipe(self, message: Message) -> Pipe:
        return Pipe(self._conditions, self._seed, message.number, f"{self._name}/{message.what}")

    def _come_out(self, arrive: Callable[[], object], connection: int) -> None:
        if connection != self._connection:
            return
        if self._conditions.hang:
            self._swallowed = True
        elif not self._conditions.outage:
            arrive()
        elif len(self._held) < HELD_MAX:
            self._held.append(arrive)
