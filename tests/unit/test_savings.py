"""What offloading would have saved, estimated from predictions and a few measured tasks."""

from random import Random

import pytest

from offboard.robot_client.learning.savings import SavingsEstimate
from offboard.robot_client.predictors.base import WARM_UP

REPETITIONS = 1_000


def test_too_little_gives_no_estimate() -> None:
    """It needs WARM_UP tasks, and as many probes if a task would have been sent."""
    estimate = SavingsEstimate()
    for _ in range(WARM_UP):
        assert estimate.estimate() is None
        estimate.stay()
    assert estimate.estimate() is not None
    estimate.move(0.1)
    for _ in range(WARM_UP):
        assert estimate.estimate() is None
        estimate.probe(0.0)
    assert estimate.estimate() is not None


def test_a_task_that_stays_saves_nothing() -> None:
    """If the policy would have sent no task, the saving is 0; if it would have sent half, it is half."""
    estimate = SavingsEstimate()
    for _ in range(20):
        estimate.stay()
    found = estimate.estimate()
    assert found is not None
    assert (found.mean_s, found.low_s, found.high_s, found.tasks, found.sent) == (0.0, 0.0, 0.0, 20, 0.0)
    for _ in range(20):
        estimate.move(0.2)
        estimate.probe(0.0)
    found = estimate.estimate()
    assert found is not None
    assert (found.mean_s, found.low_s, found.high_s) == pytest.approx((0.1, 0.1, 0.1))
    assert (found.tasks, found.sent, found.probes) == (40, 0.5, 20)


def test_the_error_of_the_predictions_is_corrected() -> None:
    """If tasks take 0.05 s longer than predicted, the saving is 0.05 s less, and may be below 0."""
    estimate = SavingsEstimate()
    for _ in range(10):
        estimate.move(0.02)
        estimate.probe(-0.05)
    found = estimate.estimate()
    assert found is not None
    assert found.mean_s == pytest.approx(-0.03)
    assert str(found).startswith(
        "-30 ms per task [-30, -30]; 100% of 10 tasks would be sent, 10 were measured"
    )


def test_the_worth_of_quality_is_said_and_not_added() -> None:
    """Of four tasks three go away, each for 0.2 s of quality, so it is 0.15 s per task; time is apart."""
    for gained_s, said in ((0.2, "better"), (-0.2, "worse")):
        estimate = SavingsEstimate()
        for _ in range(10):
            estimate.stay()
        for _ in range(30):
            estimate.move(-0.1, gained_s)
            estimate.probe(0.0)
        found = estimate.estimate()
        assert found is not None
        assert found.mean_s == pytest.approx(-0.075)
        assert found.quality_s == pytest.approx(0.75 * gained_s)
        words = f"-75 ms per task [-75, -75]; the answers would be {said}, which counts as 150 ms per task; "
        assert str(found).startswith(f"{words}75% of 40 tasks")


def test_no_word_of_quality_without_variants() -> None:
    """A task with one function for all sites has the same answers everywhere."""
    estimate = SavingsEstimate()
    for _ in range(10):
        estimate.move(1.25)
        estimate.probe(0.0)
    assert str(estimate.estimate()).startswith("1.25 s per task [1.25, 1.25]; 100% of 10 tasks would be sent")


@pytest.mark.parametrize("probes", [WARM_UP, 10, 30])
def test_the_interval_holds_the_truth_in_90_of_100_runs(probes: int) -> None:
    """The true mean saving is inside the interval in 90 % of runs, to 3 points."""
    rng, held = Random(1), 0
    for _ in range(REPETITIONS):
        estimate = SavingsEstimate()
        for number in range(10 * probes):
            estimate.move(0.3 + rng.gauss(0.0, 0.1))
            if number % 10 == 0:
                estimate.probe(-0.1 + rng.gauss(0.0, 0.05))
        found = estimate.estimate()
        assert found is not None
        held += found.low_s <= 0.2 <= found.high_s
    assert held / REPETITIONS == pytest.approx(0.9, abs=0.03)
