"""Live regret: how much time the robot's choices cost it, estimated while it runs, from its probes.

The regret of recorded runs is computed by `loadgen`.
"""

import math
from collections import deque
from dataclasses import dataclass

from offboard.robot_client.policies.prediction_errors import student_90
from offboard.robot_client.predictors.base import REMEMBERED, WARM_UP


@dataclass(frozen=True, slots=True)
class Regret:
    """The seconds that the better site would have saved per task: mean and 90 % interval over `probes`."""

    mean_s: float
    low_s: float
    high_s: float
    probes: int


class RegretEstimate:
    """Estimates regret from probes, which give both times of one task.

    Probes are due after a number of tasks, whatever these tasks were, so they are a fair sample. Hedges start
    when a site is late, so they are not.
    """

    def __init__(self) -> None:
        self._regrets: deque[float] = deque(maxlen=REMEMBERED)
        self._estimate: Regret | None = None

    def learn(self, chosen_s: float, other_s: float) -> None:
        """Take the times of a probed task: on the chosen site, and on the probed one."""
        self._regrets.append(max(0.0, chosen_s - other_s))
        if len(self._regrets) >= WARM_UP:
            self._estimate = self._fresh()

    def estimate(self) -> Regret | None:
        """The estimate; None before WARM_UP probes."""
        return self._estimate

    def _fresh(self) -> Regret:
        count = len(self._regrets)
        mean = math.fsum(self._regrets) / count
        variance = math.fsum((one - mean) ** 2 for one in self._regrets) / (count - 1)
        half = student_90(count - 1) * math.sqrt(variance / count)
        return Regret(mean, max(0.0, mean - half), mean + half, count)
