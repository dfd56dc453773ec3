"""Predictors that also use what is measured of a site (`runner.Condition`).

Measuring is left to `sites`.
"""

from abc import ABC, abstractmethod

from offboard.robot_client.predictors.base import Prediction, Predictor, check_observation
from offboard.robot_client.sites.runner import UNMEASURED, Condition

GAIN_RATE = 0.05
GAIN_MAX = 3.0
GAIN_FROM = 0.3  # a smaller feature says too little to learn its effect
STEP_MAX = 1.0  # of the relative error that one observation may move a gain by


class Conditional(ABC):
    """A predictor that is taught and asked with the condition that was measured before the task."""

    @property
    @abstractmethod
    def full(self) -> bool: ...

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def learn(self, size: float, seconds: float, condition: Condition = UNMEASURED, ahead: int = 1) -> None:
        """`ahead`: tasks since the one learnt before, as for `predict`."""

    @abstractmethod
    def predict(
        self, size: float, ahead: int = 1, condition: Condition = UNMEASURED
    ) -> Prediction | None: ...


class Gains:
    """Seconds = round trip + (1 + k_q queue + k_l load) x base time.

    The caller learns the base time, which stays valid when link or load change. The gains k are learnt in
    clipped steps along the relative error, each only while its feature is large enough. They start at 1: a
    waiting task takes as long as ours, and another busy program doubles the time.
    """

    __slots__ = ("load", "queue")

    def __init__(self) -> None:
        self.queue = self.load = 1.0

    def crowding(self, condition: Condition) -> float:
        return 1.0 + self.queue * condition.queue + self.load * condition.load

    def learn(self, ratio: float, condition: Condition) -> None:
        """`ratio`: measured over expected time, both without the round trip."""
        step = GAIN_RATE * max(-STEP_MAX, min(STEP_MAX, ratio - 1))
        if condition.queue > GAIN_FROM:
            self.queue = min(GAIN_MAX, max(0.0, self.queue + step))
        if condition.load > GAIN_FROM:
            self.load = min(GAIN_MAX, max(0.0, self.load + step))


class Measured(Conditional):
    """Any predictor, which learns and predicts the base time without the measured features."""

    def __init__(self, base: Predictor) -> None:
        self._base = base
        self._gains = Gains()

    @property
    def full(self) -> bool:
        return self._base.full

    def __len__(self) -> int:
        return len(self._base)

    def learn(
        self,
        size: float,
        seconds: float,
        condition: Condition = UNMEASURED,
        ahead: int = 1,  # noqa: ARG002
    ) -> None:
        check_observation(size, seconds)
        rest = max(0.0, seconds - (condition.round_trip_s or 0.0))
        if condition.queue or condition.load:
            found = self._base.predict(size)
            expected = found.seconds * self._gains.crowding(condition) if found else 0.0
            if expected > 0:
                self._gains.learn(rest / expected, condition)
        self._base.learn(size, rest / self._gains.crowding(condition))

    def predict(self, size: float, ahead: int = 1, condition: Condition = UNMEASURED) -> Prediction | None:
        found = self._base.predict(size, ahead)
        if found is None:
            return None
        crowding = self._gains.crowding(condition)
        return Prediction(
            (condition.round_trip_s or 0.0) + crowding * max(0.0, found.seconds),
            None if found.spread_s is None else crowding * found.spread_s,
            None if found.error_s is None else crowding * found.error_s,
        )
