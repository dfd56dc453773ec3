"""Live regret, estimated from probes."""

from random import Random

import pytest

from offboard.robot_client.learning.regret import PROBES_MAX, PROBES_MIN, RegretEstimate, student_95

REPETITIONS = 1_000


def test_too_few_probes_give_no_estimate() -> None:
    """The first estimate comes with PROBES_MIN probes."""
    estimate = RegretEstimate()
    for _ in range(PROBES_MIN - 1):
        estimate.learn(0.3, 0.1)
    assert estimate.estimate() is None
    estimate.learn(0.3, 0.1)
    found = estimate.estimate()
    assert found is not None
    assert (found.mean_s, found.low_s, found.high_s) == pytest.approx((0.2, 0.2, 0.2))
    assert found.probes == PROBES_MIN


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


@pytest.mark.parametrize("probes", [PROBES_MIN, 8, 20, 50, 200])
def test_the_interval_holds_the_truth_in_95_of_100_runs(probes: int) -> None:
    """The true mean is inside the interval in 95 % of runs, to 3 points."""
    rng, held = Random(1), 0
    for _ in range(REPETITIONS):
        estimate = RegretEstimate()
        for _ in range(probes):
            estimate.learn(0.5, 0.5 - rng.uniform(0.0, 0.2))
        found = estimate.estimate()
        assert found is not None
        held += found.low_s <= 0.1 <= found.high_s
    assert held / REPETITIONS == pytest.approx(0.95, abs=0.03)


@pytest.mark.parametrize(("freedom", "t"), [(4, 2.776), (9, 2.262), (29, 2.045), (199, 1.972)])
def test_few_probes_widen_the_interval(freedom: int, t: float) -> None:
    """The quantiles of Student's t are those of the usual tables."""
    assert student_95(freedom) == pytest.approx(t, rel=0.02)


def test_old_probes_are_forgotten() -> None:
    """Only the last PROBES_MAX probes count."""
    estimate = RegretEstimate()
    for _ in range(500):
        estimate.learn(9.0, 0.0)
    for _ in range(PROBES_MAX):
        estimate.learn(0.2, 0.1)
    found = estimate.estimate()
    assert found is not None
    assert found.probes == PROBES_MAX
    assert found.mean_s == pytest.approx(0.1)
