"""Least squares over the window: psi^l and psi^c of the paper.

The window and its sums are in `window`.
"""

import math

from offboard.common.tasks import Size
from offboard.robot_client.predictors.base import Prediction, check_observation
from offboard.robot_client.predictors.plane import Plane
from offboard.robot_client.predictors.window import Window


class LeastSquares:
    """Ordinary least squares of seconds on size over the last `window` executions.

    m = sum((d - mean d)(t - mean t)) / sum((d - mean d)^2); c = mean t - m mean d; p = m d + c.
    If all sizes are equal, the slope is 0 and p = mean t. Sizes of several numbers get a plane.
    The standard error of p is that of the fitted line: s sqrt(1 / N + (d - mean d)^2 / sum((d - mean d)^2)).
    """

    several_numbers = True  # sizes may be tuples

    def __init__(self, window: int, seed: int = 0) -> None:  # noqa: ARG002 - nothing is random
        self.window = Window(window)
        self._plane = Plane(window)  # empty, or the window is

    @property
    def full(self) -> bool:
        return self.window.full or self._plane.full

    def __len__(self) -> int:
        return len(self.window) or len(self._plane)

    def learn(self, size: Size, seconds: float) -> None:
        if isinstance(size, tuple):
            for number in size:
                check_observation(number, seconds)
            self._plane.learn(size, seconds)
            return
        check_observation(size, seconds)
        self.window.append(size, seconds)

    def predict(self, size: Size, ahead: int = 1) -> Prediction | None:  # noqa: ARG002
        if isinstance(size, tuple):
            return self._plane.predict(size)
        if not len(self.window):
            return None
        of = self.window.moments()
        slope, away = of.sdt / of.sdd if of.sdd > 0 else 0.0, of.deviation(size)
        seconds = of.mean_seconds + slope * away
        if of.count <= 2:
            return Prediction(seconds, None)
        spread_s = math.sqrt(max(0.0, of.stt - slope * of.sdt) / (of.count - 2))
        leverage = 1.0 / of.count + (away * away / of.sdd if of.sdd > 0 else 0.0)
        return Prediction(seconds, spread_s, spread_s * math.sqrt(leverage))
