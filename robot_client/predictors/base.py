"""The contract of every predictor: learn what happened on one site, say what will."""

import math
from collections import deque
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from robot_client.window import checked_length

Column = npt.NDArray[np.float64]

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


class Refitted:
    """Base of the predictors that fit a model to the whole window.

    A prediction fits anew where observations came since the last fit; with `refit_share` k, where at least
    1/k as many came as that one was made on. A leaf has `_fit` and `_estimate`; `_follow` is for those that
    keep step with each observation between two fits.
    """

    def __init__(self, window: int, refit_share: int | None = None) -> None:
        self.window = checked_length(window)
        self.refit_share = refit_share
        self._observations: deque[tuple[float, float]] = deque(maxlen=window)
        self._unfitted = 0  # observations since the last fit
        self._refit_at = 0  # so many of them; 0: never fitted

    @property
    def full(self) -> bool:
        return len(self._observations) == self.window

    def __len__(self) -> int:
        return len(self._observations)

    def learn(self, size: float, seconds: float) -> None:
        check_observation(size, seconds)
        self._observations.append((size, seconds))
        self._unfitted += 1
        if self._refit_at:
            self._follow(size, seconds)

    def predict(self, size: float, ahead: int = 1) -> Prediction | None:
        if not self._observations:
            return None
        if self._unfitted >= self._refit_at:
            sizes, seconds = np.array(self._observations, dtype=np.float64).T.copy()
            self._fit(sizes, seconds)
            self._unfitted = 0
            self._refit_at = max(1, len(sizes) // self.refit_share) if self.refit_share else 1
        return self._estimate(size, ahead)

    def _fit(self, sizes: Column, seconds: Column) -> None:
        """Fit to the window, oldest first; it holds at least one observation."""
        raise NotImplementedError

    def _follow(self, size: float, seconds: float) -> None:
        """Take in one observation without fitting."""

    def _estimate(self, size: float, ahead: int) -> Prediction:
        """The prediction of the model as fitted."""
        raise NotImplementedError


def check_observation(size: float, seconds: float) -> None:
    """The check every `learn` starts with."""
    if not (0 <= size < math.inf and 0 <= seconds < math.inf):
        raise ValueError(f"observation ({size}, {seconds}): size and seconds must be finite and not negative")
