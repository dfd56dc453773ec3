"""A forest of regression trees over the window, which can follow any curve or step."""

import math

import numpy as np

from offboard.common.errors import MissingExtra
from offboard.loadgen.rivals.refitted import Column, Refitted
from offboard.robot_client.predictors.base import Prediction

try:
    from sklearn.ensemble import RandomForestRegressor
except ImportError as error:
    raise MissingExtra("predictor random-forest", "learned") from error

TREES = 100  # scikit-learn's default


class RandomForest(Refitted):
    """scikit-learn's RandomForestRegressor on the size, stored as the step function that it is.

    It is fitted again after a tenth as many observations as the last fit had, because a fit takes a tenth of
    a second.
    A forest does not extrapolate: sizes beyond the smallest and largest one are predicted as those two.
    The spread is the standard deviation of the out-of-bag residuals: each observation is compared with the
    trees that were not trained on it.
    """

    refit_share = 10

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

    def _estimate(self, size: float, ahead: int) -> Prediction:  # noqa: ARG002 - not a time series
        step = np.searchsorted(self._thresholds, self._place(size))
        return Prediction(float(self._seconds[step]), self._spread)

    def _place(self, size: float) -> np.float32:
        """0 for the smallest size of the window, 1 for the largest, in 32 bits as in scikit-learn's trees."""
        place = (size - self._low) / self._range if self._range else 0.0
        return np.float32(min(max(place, 0.0), 1.0))


def leaf_min(count: int) -> int:
    """The smallest number of observations in a leaf: 1 of 10, 2 of 20, 5 of 100, 14 of 800.

    Full-grown trees follow the noise. On lines, curves and steps with and without noise, half the square root
    was never far from the best of 1, 3, 5, 20 and the square root.
    """
    return max(1, math.isqrt(count) // 2)


def _steps(forest: RandomForestRegressor) -> tuple[Column, Column]:
    """Thresholds a < b < .. of all trees, and one prediction more: for x <= a, a < x <= b, .."""
    trees = [tree.tree_ for tree in forest.estimators_]
    inner = [tree.threshold[tree.children_left != tree.children_right] for tree in trees]
    thresholds = np.unique(np.concatenate(inner))
    # The largest 32-bit number in each step. A step that holds none is never asked for.
    within = thresholds.astype(np.float32)
    within = np.where(within > thresholds, np.nextafter(within, np.float32(-1)), within)
    seconds: Column = forest.predict(np.append(within, np.float32(1))[:, np.newaxis])
    return thresholds, seconds
