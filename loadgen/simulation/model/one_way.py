"""One direction of a simulated connection, by the model of the relay's link."""

from collections import deque
from collections.abc import Callable
from functools import partial

from offboard.loadgen.relay.link.link import LinkConditions, Pipe
from offboard.loadgen.simulation.model.clock import VirtualClock

HELD_MAX = 100_000  # messages that an outage holds; what is beyond finds full buffers


class Way:
    """Carries messages in order. `seed` and `name` are its draws' own.

    Each message has draws of its own, from its name: the same task has the same delay and loss whatever was
    sent before it. So there is no correlation, and no burst of loss, from one message to the next.
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

    @property
    def conditions(self) -> LinkConditions:
        return self._conditions

    def send(self, size: int, what: str, number: int, arrive: Callable[[], object]) -> None:
        """Let `arrive` happen when the last byte of message `number` of its sort comes out."""
        begins_s = max(self._clock.now_s(), self._free_s)
        self._last_due_s = max(self._last_due_s, self._comes_out_s(size, what, number, begins_s))
        bandwidth = self._conditions.bandwidth_mbps
        self._free_s = begins_s + (8e-6 * size / bandwidth if bandwidth else 0.0)
        self._clock.at(self._last_due_s, partial(self._come_out, arrive, self._connection))

    def due_s(self, size: int, what: str, number: int, sent_s: float) -> float | None:
        """When such a message would come out on an idle way that stays as it is; None for never."""
        if self._conditions.outage or self._conditions.hang:
            return None
        return self._comes_out_s(size, what, number, sent_s)

    def change(self, conditions: LinkConditions) -> bool:
        """From now on; False where a hang has ended that took what was said: the connection is lost."""
        self._conditions = conditions
        if self._swallowed and not conditions.hang:
            return False
        while self._held and not conditions.outage:
            self._held.popleft()()
        return True

    def lose(self) -> None:
        """The connection is lost, and all that is under way."""
        self._connection += 1
        self._held.clear()
        self._swallowed = False
        self._free_s = self._last_due_s = self._clock.now_s()

    def _comes_out_s(self, size: int, what: str, number: int, begins_s: float) -> float:
        return Pipe(self._conditions, self._seed, number, f"{self._name}/{what}").due(begins_s, size)

    def _come_out(self, arrive: Callable[[], object], connection: int) -> None:
        if connection != self._connection:
            return
        if self._conditions.hang:
            self._swallowed = True
        elif not self._conditions.outage:
            arrive()
        elif len(self._held) < HELD_MAX:
            self._held.append(arrive)
