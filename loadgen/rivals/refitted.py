"""The base of the predictors that fit a model to the whole window.

The models are left to its subclasses.
"""

from collections import deque

import numpy as np
import numpy.typing as npt

from offboard.robot_client.predictors.base import Prediction, check_observation
from offboard.robot_client.predictors.window import checked_length

Column = npt.NDArray[np.float64]


class Refitted:
    """Keeps a window of observations, and fits the model when a prediction is asked for.

    A subclass defines `refit_share`, `_fit` and `_estimate`, and `_follow` if the model changes between two
    fits. `seed` is for models that draw random numbers.
    """

    refit_share: int  # with k, the model is fitted again after 1/k as many observations as the last fit had

    def __init__(self, window: int, seed: int = 0) -> None:
        self.window = checked_length(window)
        self.seed = seed
        self._observations: deque[tuple[float, float]] = deque(maxlen=window)
        self._unfitted = 0  # observations since the last fit
        self._refit_at = 0  # that many of them start a fit; 0 before the first fit

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
            self._refit_at = max(1, len(sizes) // self.refit_share)
        return self._estimate(size, ahead)

    def _fit(self, sizes: Column, seconds: Column) -> None:
        """Fit the model to the window, oldest first; there is at least one observation."""
        raise NotImplementedError

    def _follow(self, size: float, seconds: float) -> None:
        """Take in one observation between two fits."""

    def _estimate(self, size: float, ahead: int) -> Prediction:
        raise NotImplementedError
