"""The contract of every predictor: learn what happened on one site, say what will."""

import math
from typing import NamedTuple, Protocol

SIZE_MIN = 1e-100  # sizes that differ by less are equal: a steeper line would leave the range of a float


class Prediction(NamedTuple):
    """Expected `seconds` of a task, and the standard deviation of what was seen around it (None: unknown).

    `error_s` is the standard error of the expectation itself, where the predictor knows it.
    """

    seconds: float
    spread_s: float | None
    error_s: float | None = None


class Predictor(Protocol):
    """Learns the time of one kind of task on one site. Called from one thread at a time.

    `copy.deepcopy` and pickle carry all that it has learnt; memory is bounded by its window, however much
    it is taught.
    """

    @property
    def full(self) -> bool:
        """Whether warm-up is over for this site."""

    def __len__(self) -> int:
        """Observations it rests on, at most the window."""

    def learn(self, size: float, seconds: float) -> None:
        """Take one finished execution; ValueError unless both are finite and not negative."""

    def predict(self, size: float, ahead: int = 1) -> Prediction | None:
        """For a task of this size; None until it has learnt anything.

        `ahead` counts tasks since the last one learnt: 1 is the next one, more where this site has not run
        the tasks between. Only predictors of a sequence look at it.
        """


def check_observation(size: float, seconds: float) -> None:
    """The check every `learn` starts with."""
    if not (0 <= size < math.inf and 0 <= seconds < math.inf):
        raise ValueError(f"observation ({size}, {seconds}): size and seconds must be finite and not negative")
