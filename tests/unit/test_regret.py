"""Live regret, estimated from probes."""

from random import Random

import pytest

from offboard.robot_client.learning.regret import RegretEstimate
from offboard.robot_client.policies.prediction_errors import student_90
from offboard.robot_client.predictors.base import REMEMBERED, WARM_UP

REPETITIONS = 1_000


def test_too_few_probes_give_no_estimate() -> None:
    """The first estimate comes with WARM_UP probes."""
    estimate = RegretEstimate()
    for _ in range(WARM_UP - 1):
        estimate.learn(0.3, 0.1)
    assert estimate.estimate() is None
    estimate.learn(0.3, 0.1)
    found = estimate.estimate()
    assert found is not None
    assert (found.mean_s, found.low_s, found.high_s) == pytest.approx((0.2, 0.2, 0.2))
    assert found.probes == WARM_UP


def test_a_right_choice_has_no_regret() -> None:
    """Time gained by a right choice does not reduce the regret of wrong choices."""
    estimate = RegretEstimate()
    for _ in range(10):
        estimate.learn(0.1, 9.0)
        estimate.learn(0.4, 0.2)
    found = estimate.estimate()
    assert found is not None
    assert found.mean_s == pytest.approx(0.1)
    assert 0 <= found.low_s < found.mean_s < found.high_s


@pytest.mark.parametrize("probes", [WARM_UP, 8, 20, 50, 200])
def test_the_interval_holds_the_truth_in_90_of_100_runs(probes: int) -> None:
    """The true mean is inside the interval in 90 % of runs, to 3 points."""
    rng, held = Random(1), 0
    for _ in range(REPETITIONS):
        estimate = RegretEstimate()
        for _ in range(probes):
            estimate.learn(0.5, 0.5 - rng.uniform(0.0, 0.2))
        found = estimate.estimate()
        assert found is not None
        held += found.low_s <= 0.1 <= found.high_s
    assert held / REPETITIONS == pytest.approx(0.9, abs=0.03)


@pytest.mark.parametrize(("freedom", "t"), [(2, 2.920), (4, 2.132), (9, 1.833), (29, 1.699), (199, 1.653)])
def test_few_probes_widen_the_interval(freedom: int, t: float) -> None:
    """The quantiles of Student's t are those of the usual tables."""
    assert student_90(freedom) == pytest.approx(t, rel=0.02)


def test_old_probes_are_forgotten() -> None:
    """Only the last REMEMBERED probes count."""
    estimate = RegretEstimate()
    for _ in range(500):
        estimate.learn(9.0, 0.0)
    for _ in range(REMEMBERED):
        estimate.learn(0.2, 0.1)
    found = estimate.estimate()
    assert found is not None
    assert found.probes == REMEMBERED
    assert found.mean_s == pytest.approx(0.1)
