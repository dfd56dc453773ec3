"""The contract of every predictor: it learns what happened on one site, and predicts what will.

Where a task runs is decided in `policies`.
"""

import math
from typing import NamedTuple, Protocol

WARM_UP = 6  # runs of a site, after which its predictions are compared with those of others
REMEMBERED = 200  # observations of a site, sizes with their work, and probes
SIZE_MIN = 1e-100  # smaller differences of sizes are 0: a steeper line would leave the range of a float
ROUNDING = 1e-12  # smaller relative differences are rounding errors


class Prediction(NamedTuple):
    """What a task is expected to take.

    spread_s: standard deviation of the observed times around the prediction; None if unknown.
    error_s: standard error of `seconds` itself; None if unknown.
    """

    seconds: float
    spread_s: float | None
    error_s: float | None = None


class Predictor(Protocol):
    """Learns the times of one kind of task on one site. Only one thread at a time calls it.

    `copy.deepcopy` and pickle keep everything that it has learnt. Its window bounds its memory.
    """

    @property
    def full(self) -> bool:
        """Whether the warm-up of this site is over."""

    def __len__(self) -> int:
        """The number of observations that predictions use, at most the window."""

    def learn(self, size: float, seconds: float) -> None:
        """Learn one finished execution. ValueError unless both values are finite and not negative."""

    def predict(self, size: float, ahead: int = 1) -> Prediction | None:
        """The prediction for a task of this size; None before the first observation.

        `ahead` counts tasks since the last one learnt. It is 1 for the next task, and more if this site did
        not run the tasks in between. Only predictors of a time series use it.
        """


def check_observation(size: float, seconds: float) -> None:
    """The check that every `learn` starts with."""
    if not (0 <= size < math.inf and 0 <= seconds < math.inf):
        raise ValueError(f"observation ({size}, {seconds}): size and seconds must be finite and not negative")
