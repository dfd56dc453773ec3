"""How much time the robot's choices cost it, estimated live from its own shadow probes."""

import math
from collections import deque
from dataclasses import dataclass

PROBES_MAX = 200  # the last ones, of all kinds
PROBES_MIN = 5
NORMAL_95 = 1.959964


@dataclass(frozen=True, slots=True)
class Regret:
    """Mean seconds a task that the better site would have saved, with its 95 % interval."""

    mean_s: float
    low_s: float
    high_s: float
    probes: int


class RegretEstimate:
    """A probe tells both times of one task: that of the site it was meant for, and that of another.

    Probes come after so many tasks, whatever these were, so they are a fair sample of the tasks at those
    moments; hedges come where a site is late, and are none.
    """

    def __init__(self) -> None:
        self._regrets: deque[float] = deque(maxlen=PROBES_MAX)
        self._estimate: Regret | None = None

    def learn(self, chosen_s: float, other_s: float) -> None:
        self._regrets.append(max(0.0, chosen_s - other_s))
        if len(self._regrets) >= PROBES_MIN:
            self._estimate = self._fresh()

    def estimate(self) -> Regret | None:
        """None before PROBES_MIN probes."""
        return self._estimate

    def _fresh(self) -> Regret:
        count = len(self._regrets)
        mean = math.fsum(self._regrets) / count
        variance = math.fsum((one - mean) ** 2 for one in self._regrets) / (count - 1)
        half = student_95(count - 1) * math.sqrt(variance / count)
        return Regret(mean, max(0.0, mean - half), mean + half, count)


def student_95(freedom: int) -> float:
    """Student's t that 97.5 % are below, to 2 % from 4 degrees of freedom on (Abramowitz, Stegun 26.7.5)."""
    z = NORMAL_95
    return z + (z**3 + z) / (4 * freedom) + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * freedom**2)
