"""The contract of every predictor: learn what happened on one site, say what will."""

import math
from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True)
class Prediction:
    """Expected `seconds` of a task, and the standard deviation of what was seen around it (None: unknown)."""

    seconds: float
    spread_s: float | None


class Predictor(Protocol):
    """Learns the time of one kind of task on one site. Called from one thread at a time."""

    @property
    def full(self) -> bool:
        """Whether warm-up is over for this site."""

    def __len__(self) -> int:
        """Observations it holds."""

    def learn(self, size: float, seconds: float) -> None:
        """Take one finished execution; ValueError unless both are finite and not negative."""

    def predict(self, size: float) -> Prediction | None:
        """For a task of this size; None until it has learnt anything."""


def check_observation(size: float, seconds: float) -> None:
    """The check every `learn` starts with."""
    if not (0 <= size < math.inf and 0 <= seconds < math.inf):
        raise ValueError(f"observation ({size}, {seconds}): size and seconds must be finite and not negative")
