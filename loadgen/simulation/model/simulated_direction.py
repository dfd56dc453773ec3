"""One direction of a simulated connection: carries messages, with the link model of the relay."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from offboard.loadgen.relay.link.link import LinkConditions
from offboard.loadgen.relay.link.pipe import Pipe
from offboard.loadgen.simulation.model.virtual_clock import VirtualClock

HELD_MAX = 100_000  # messages that an outage holds; further messages are lost, as with full buffers


@dataclass(frozen=True, slots=True)
class Message:
    """A message on the link. `what` is its sort, and `number` tells apart the messages of one sort."""

    size: int
    what: str
    number: int


class SimulatedDirection:
    """Carries messages in order.

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

    def due_s(self, message: Message, sent_s: float) -> float | None:
        """When this message would come out if the link were idle and did not change; None means never."""
        if self._conditions.outage or self._conditions.hang:
            return None
        return self._pipe(message).due(sent_s, message.size)

    def delay_ms(self) -> float:
        """The delay of a message that enters now, without jitter."""
        conditions, played = self._conditions, self._conditions.recording
        return conditions.delay_ms + (played.delay_ms(self._clock.now_s()) if played else 0.0)

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
