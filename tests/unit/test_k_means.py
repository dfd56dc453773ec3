"""k-means as a predictor: what it promises beyond the contract of predictors."""

import random

import numpy as np
import pytest

from offboard.loadgen.rivals import make
from offboard.robot_client.predictors import Predictor

cluster = pytest.importorskip("sklearn.cluster", reason="scikit-learn is not installed: `make install`")


def taught(rows: list[tuple[float, float]], seed: int = 0) -> Predictor:
    predictor = make("k-means", len(rows), seed)
    for row in rows:
        predictor.learn(*row)
    return predictor


def seconds(predictor: Predictor, size: float) -> float:
    prediction = predictor.predict(size)
    assert prediction is not None
    return prediction.seconds


def test_groups_of_sizes_get_their_mean_times() -> None:
    """Three sizes with a bend between them, as a map with three rooms: each has the mean of its times."""
    times = {1.0: (0.1, 0.2), 2.0: (0.7, 0.9), 3.0: (0.3, 0.4)}
    predictor = taught([(size, time) for size, pair in times.items() for time in pair])
    for size, pair in times.items():
        assert seconds(predictor, size) == pytest.approx(sum(pair) / 2)
    assert seconds(predictor, 0.0) == seconds(predictor, 1.0)
    assert seconds(predictor, 1e9) == seconds(predictor, 3.0)


def test_the_clusters_are_those_of_scikit_learn() -> None:
    """Every observation is predicted as the mean time of the cluster that scikit-learn puts it into."""
    rng = random.Random(3)
    rows = [(rng.uniform(0, 5), rng.uniform(0, 1)) for _ in range(100)]
    sizes, times = np.array(rows).T
    places = (sizes - sizes.min()) / np.ptp(sizes)
    labels = cluster.KMeans(10, n_init=1, random_state=7).fit_predict(places[:, np.newaxis])
    predictor = taught(rows, seed=7)
    for size, label in zip(sizes.tolist(), labels, strict=True):
        assert seconds(predictor, size) == pytest.approx(float(times[labels == label].mean()))


@pytest.mark.parametrize(("count", "expected"), [(1, 2), (8, 4), (50, 8), (800, 19)])
def test_the_number_of_clusters_follows_rice(count: int, expected: int) -> None:
    """Twice the cube root of the number of observations; as many as there are different sizes, at most."""
    from offboard.loadgen.rivals.k_means import clusters

    assert clusters(count) == expected
