"""Predictors that use the measured condition of a site."""

from random import Random

import pytest

from offboard.robot_client import predictors
from offboard.robot_client.predictors.features import GAIN_MAX, Measured
from offboard.robot_client.predictors.least_squares import LeastSquares
from offboard.robot_client.sites.runner import Condition

QUIET = Condition()


def measured(window: int = 50) -> Measured:
    return Measured(LeastSquares(window))


def taught(one: Measured, condition: Condition, factor: float, tasks: int = 200, seed: int = 1) -> Measured:
    """A predictor that learnt 0.1 s per size, `factor` times as much under `condition`, with 5 % noise."""
    rng = Random(seed)
    for n in range(tasks):
        now = condition if n % 2 else QUIET
        size = rng.uniform(1, 5)
        one.learn(size, 0.1 * size * (factor if n % 2 else 1.0) * rng.lognormvariate(0, 0.05), now)
    return one


def seconds(one: Measured, condition: Condition, size: float = 2.0) -> float:
    found = one.predict(size, 1, condition)
    assert found is not None
    return found.seconds


@pytest.mark.parametrize("condition", [Condition(queue=1), Condition(load=0.9)], ids=["queue", "load"])
@pytest.mark.parametrize(("factor", "more"), [(3.0, True), (1.0, False)])
def test_a_gain_moves_towards_what_the_feature_does(condition: Condition, factor: float, more: bool) -> None:
    """If a feature costs more than assumed, the prediction grows; otherwise it falls."""
    believed = seconds(measured_of(0.2), condition)
    learnt = seconds(taught(measured(), condition, factor), condition)
    assert (learnt > believed) == more
    assert learnt == pytest.approx(0.2 * factor, rel=0.25)


def measured_of(at_2: float) -> Measured:
    one = measured()
    for size in (1.0, 2.0, 3.0):
        one.learn(size, at_2 * size / 2)
    return one


@pytest.mark.parametrize("factor", [0.001, 1_000.0])
def test_gains_stay_within_bounds(factor: float) -> None:
    """A gain is always from 0 to GAIN_MAX."""
    for condition in (Condition(queue=40), Condition(load=1.0)):
        one = taught(measured(), condition, factor)
        for gain in (one._gains.queue, one._gains.load):
            assert 0 <= gain <= GAIN_MAX


def test_a_small_feature_changes_no_gain() -> None:
    """Features below GAIN_FROM leave their gain alone."""
    one = taught(measured(), Condition(load=0.2), 5.0)
    assert one._gains.load == 1.0


def test_a_link_that_changes_needs_no_relearning() -> None:
    """When the round trip grows from 20 to 300 ms, the next prediction is right at once."""
    one = measured()
    for size in (1.0, 2.0, 3.0, 4.0):
        one.learn(size, 0.02 + 0.1 * size, Condition(round_trip_s=0.02))
    for trip_s in (0.02, 0.3, 0.0):
        assert seconds(one, Condition(round_trip_s=trip_s)) == pytest.approx(trip_s + 0.2)


def test_a_task_shorter_than_its_round_trip_is_no_negative_time() -> None:
    """The time at the server is then 0."""
    one = measured()
    one.learn(1.0, 0.01, Condition(round_trip_s=0.5))
    assert seconds(one, QUIET) == 0.0


def test_spread_and_standard_error_grow_with_the_queue() -> None:
    """With one task in the queue, both are twice as large as without."""
    one = predictors.make("features:bayesian-least-squares", 50)
    assert isinstance(one, Measured)
    rng = Random(1)
    for _ in range(20):
        size = rng.uniform(1, 5)
        one.learn(size, 0.1 * size + rng.uniform(0, 0.01))
    alone, crowded = one.predict(2.0), one.predict(2.0, 1, Condition(queue=1))
    assert alone is not None
    assert crowded is not None
    assert alone.spread_s is not None
    assert alone.error_s is not None
    assert crowded.spread_s == pytest.approx(2 * alone.spread_s)
    assert crowded.error_s == pytest.approx(2 * alone.error_s)
