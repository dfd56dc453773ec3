"""The rules by which peers ask for their next chunk, as rivals of `offboard.robot_client.streams`.

`broker` asks when the queue is empty, as openpi's ActionChunkBroker. `half-empty` asks when half of it is
left, as the client of LeRobot's asynchronous inference. `fixed-interval` asks twice in each horizon. None of
them has a second site or gives up. The others ask as `stream`, but forecast arrivals by another delay: the
largest one ever (`max-ever`), the 95th percentile of the last 100 (`p95`; LeRobot's real-time chunking had
both), or a moving average (`ewma`).
"""

import math
from collections import deque
from collections.abc import Callable, Mapping
from statistics import quantiles

from offboard.robot_client.sites.runner import CLOUD
from offboard.robot_client.streams.arrival import Arrival
from offboard.robot_client.streams.asking import Asking, Pace

STREAM = "stream"
PATIENCE_S = 600.0  # of a rule that waits for each answer
KEPT = 100  # delays that the rule `p95` looks at
EWMA_GAIN = 0.1
ROUNDING_S = 1e-9


class ServerOnly(Asking):
    """Asks the server alone, one question at a time.

    least_s: asks when the queue lasts no longer. every_s: asks this long after the last question.
    """

    patience_s = PATIENCE_S

    def __init__(self, pace: Pace, *, least_s: float = -1.0, every_s: float = math.inf) -> None:
        super().__init__(pace)
        self._least_s, self._every_s = least_s, every_s

    def due(self, now_s: float, left_s: float, lost_s: Mapping[str, float], *, seen: int) -> list[str]:  # noqa: ARG002
        asked_s, _ = self._asked.get(CLOUD, (-math.inf, -1))
        due = left_s <= self._least_s or now_s - asked_s >= self._every_s - ROUNDING_S
        return [CLOUD] if due and CLOUD not in self._under_way else []


class Largest(Arrival):
    """Expects the largest delay so far."""

    _largest_s: float | None = None

    @property
    def late_s(self) -> float | None:
        return self._largest_s

    def learn(self, seconds: float) -> None:
        super().learn(seconds)
        self._largest_s = max(self._largest_s or 0.0, seconds)


class Percentile(Arrival):
    """Expects the 95th percentile of the last delays."""

    def __init__(self, miss_rate: float) -> None:
        super().__init__(miss_rate)
        self._delays: deque[float] = deque(maxlen=KEPT)

    @property
    def late_s(self) -> float | None:
        if len(self._delays) < 2:
            return self.mean_s
        return quantiles(self._delays, n=20, method="inclusive")[-1]

    def learn(self, seconds: float) -> None:
        self._delays.append(seconds)
        super().learn(seconds)


class MovingAverage(Arrival):
    """Expects a moving average of the delays."""

    _average_s: float | None = None

    @property
    def late_s(self) -> float | None:
        return self._average_s

    def learn(self, seconds: float) -> None:
        super().learn(seconds)
        before_s = seconds if self._average_s is None else self._average_s
        self._average_s = before_s + EWMA_GAIN * (seconds - before_s)


DELAYS: Mapping[str, Callable[[float], Arrival]] = {
    STREAM: Arrival,
    "max-ever": Largest,
    "p95": Percentile,
    "ewma": MovingAverage,
}
RULES: Mapping[str, Callable[[Pace], Asking]] = {
    **{name: (lambda pace, make=make: Asking(pace, make)) for name, make in DELAYS.items()},  # type: ignore[misc]
    "broker": lambda pace: ServerOnly(pace, least_s=0.0),
    "half-empty": lambda pace: ServerOnly(pace, least_s=0.5 * pace.horizon_s),
    "fixed-interval": lambda pace: ServerOnly(pace, every_s=0.5 * pace.horizon_s),
}
