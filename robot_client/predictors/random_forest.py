"""A forest of regression trees on the window, which takes on any bend or step of the data."""

import math

import numpy as np

from offboard.common.errors import MissingExtra
from offboard.robot_client.predictors.base import Prediction
from offboard.robot_client.predictors.refitted import Column, Refitted

try:
    from sklearn.ensemble import RandomForestRegressor
except ImportError as error:
    raise MissingExtra("predictor random-forest", "learned") from error

TREES = 100  # scikit-learn's default
REFIT_SHARE = 10  # a fit takes a tenth of a second, so it is made anew after a tenth as many observations


class RandomForest(Refitted):
    """scikit-learn's RandomForestRegressor on the size alone, as the step function of the size that it is.

    Fitted anew once a tenth as many observations have come as the last fit was made on.
    The smallest and largest size seen stand for all beyond them: a forest does not extrapolate.
    The spread is out of bag: the standard deviation of the residuals, each to the trees that had not seen
    its observation.
    """

    def __init__(self, window: int, seed: int = 0) -> None:
        super().__init__(window, REFIT_SHARE)
        self.seed = seed

    def _fit(self, sizes: Column, seconds: Column) -> None:
        self._low = float(sizes.min())
        self._range = float(sizes.max()) - self._low
        self._thresholds, self._seconds, self._spread = np.empty(0), seconds[:1], None
        if len(sizes) == 1:
            return
        forest = RandomForestRegressor(
            TREES, min_samples_leaf=leaf_min(len(sizes)), oob_score=True, random_state=self.seed, n_jobs=1
        )
        places = np.array([self._place(size) for size in sizes.tolist()])
        forest.fit(places[:, np.newaxis], seconds)
        self._thresholds, self._seconds = _steps(forest)
        self._spread = math.sqrt(float(np.mean((seconds - forest.oob_prediction_) ** 2)))

    def _estimate(self, size: float, ahead: int) -> Prediction:  # noqa: ARG002 - the next task is as any other
        step = np.searchsorted(self._thresholds, self._place(size))
        return Prediction(float(self._seconds[step]), self._spread)

    def _place(self, size: float) -> np.float32:
        """0 for the smallest size of the window, 1 for the largest; scikit-learn's trees look at 32 bits."""
        place = (size - self._low) / self._range if self._range else 0.0
        return np.float32(min(max(place, 0.0), 1.0))


def leaf_min(count: int) -> int:
    """Least observations in a leaf: 1 of 10, 2 of 20, 5 of 100, 14 of 800.

    Full-grown trees follow the noise; on lines, bends and steps with and without noise, half the root was
    never far from the best of 1, 3, 5, 20 and the root.
    """
    return max(1, math.isqrt(count) // 2)


def _steps(forest: RandomForestRegressor) -> tuple[Column, Column]:
    """Thresholds a < b < .. of all trees, and what the forest says of x <= a, a < x <= b, ..: one more."""
    trees = [tree.tree_ for tree in forest.estimators_]
    inner = [tree.threshold[tree.children_left != tree.children_right] for tree in trees]
    thresholds = np.unique(np.concatenate(inner))
    # The largest number of 32 bits in each step; where a step holds none, nobody will ask for it.
    within = thresholds.astype(np.float32)
    within = np.where(within > thresholds, np.nextafter(within, np.float32(-1)), within)
    seconds: Column = forest.predict(np.append(within, np.float32(1))[:, np.newaxis])
    return thresholds, seconds
