"""Clusters of sizes, each with its mean time: the k-means that the paper names."""

import math
import threading

import numpy as np

from offboard.common.errors import MissingExtra
from offboard.loadgen.rivals.refitted import Column, Refitted
from offboard.robot_client.predictors.base import Prediction

try:
    from sklearn.cluster import KMeans
    from threadpoolctl import ThreadpoolController  # type: ignore[import-untyped]
except ImportError as error:
    raise MissingExtra("predictor k-means", "learned") from error

FITTING = threading.Lock()  # a fit changes the number of threads of the whole process, and restores it
# With several threads, a fit took 20 times as long: they wait for each other.
THREADS = ThreadpoolController()


class KMeansOfSizes(Refitted):
    """scikit-learn's KMeans on the size. The prediction is the mean time of the cluster of the size.

    It is fitted again after a tenth as many observations as the last fit had.
    Sizes beyond the outermost cluster are predicted as that cluster.
    The spread is the standard deviation of the residuals over the window.
    """

    refit_share = 10

    def _fit(self, sizes: Column, seconds: Column) -> None:
        self._low = float(sizes.min())
        self._range = float(sizes.max()) - self._low
        places = self._places(sizes)
        count = min(clusters(len(sizes)), len(np.unique(places)))
        with FITTING, THREADS.limit(limits=1):
            found = KMeans(count, n_init=1, random_state=self.seed).fit(places[:, np.newaxis])
        centres = np.sort(found.cluster_centers_.ravel())
        self._limits = (centres[1:] + centres[:-1]) / 2
        cluster = np.searchsorted(self._limits, places)
        # A centre may be the nearest one of no size; then its neighbours are one cluster.
        kept, cluster = np.unique(cluster, return_inverse=True)
        self._limits = self._limits[kept[:-1]]
        first = seconds[0]  # so that equal times have exactly that mean
        self._seconds = first + np.bincount(cluster, seconds - first) / np.bincount(cluster)
        left, free = seconds - self._seconds[cluster], len(seconds) - len(kept)
        self._spread = math.sqrt(float(left @ left) / free) if free > 0 else None

    def _estimate(self, size: float, ahead: int) -> Prediction:  # noqa: ARG002 - not a time series
        cluster = np.searchsorted(self._limits, self._places(np.array(size)))
        return Prediction(float(self._seconds[cluster]), self._spread)

    def _places(self, sizes: Column) -> Column:
        """0 for the smallest size of the window, 1 for the largest."""
        places: Column = np.clip((sizes - self._low) / (self._range or 1.0), 0.0, 1.0)
        return places


def clusters(count: int) -> int:
    """Twice the cube root of the number of observations (Rice's rule): 8 of 50, 19 of 800.

    With more clusters a step is smaller, but its mean has fewer observations; both errors are equal if k
    grows with the cube root.
    """
    return math.ceil(2 * math.pow(count, 1 / 3))
