"""The average of three predictors."""

from random import Random

import pytest

from offboard.robot_client.predictors.average import FEARED, START, Average, blind_average
from offboard.robot_client.sites.runner import UNMEASURED, Condition


class Says:
    """A predictor that always says the same."""

    full = True

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds

    def __len__(self) -> int:
        return 1

    def learn(self, size: float, seconds: float) -> None:
        pass

    def expect(self, size: float) -> float:  # noqa: ARG002
        return self.seconds


def of(seen: float, left: float, paced: float) -> Average:
    """An average after its start, whose models predict these values."""
    one = blind_average(50)
    one._first = [(2.0, 1.0, UNMEASURED)] * START
    one._seen, one._left, one._paced = Says(seen), Says(left), Says(paced)  # type: ignore[assignment]
    return one


def predicted(one: Average, condition: Condition = UNMEASURED) -> float:
    found = one.predict(2.0, 1, condition)
    assert found is not None
    return found.seconds


@pytest.mark.parametrize("at", range(10))
def test_one_of_the_first_may_be_an_outlier(at: int) -> None:
    """Soon after the start, the line is that of the other observations, wherever the outlier was."""
    one, rng = blind_average(50), Random(at)
    for n in range(12):
        size = rng.uniform(1, 5)
        one.learn(size, (20 if n == at else 1) * (0.1 + 0.1 * size) * rng.uniform(0.95, 1.05))
    assert predicted(one) == pytest.approx(0.3, rel=0.35)


def test_clipped_times_count_in_the_mean() -> None:
    """If one task in ten takes ten times as long, the prediction is between the usual time and the mean."""
    one, rng = blind_average(50), Random(1)
    for n in range(300):
        one.learn(rng.uniform(1, 5), rng.uniform(0.9, 1.1) * (10 if n % 10 == 9 else 1))
    assert 1.2 < predicted(one) < 1.9


def test_clipped_times_fade_while_the_site_is_not_used() -> None:
    """They fade more with every task without news, and the next observation makes this permanent."""

    def after(tasks: int) -> float:
        found = one.predict(2.0, 1 + tasks)
        assert found is not None
        return found.seconds

    one, rng = blind_average(50), Random(1)
    for n in range(26):
        one.learn(rng.uniform(1, 5), rng.uniform(0.9, 1.1) * (20 if n in (3, 8, 23, 25) else 1))
    feared = after(0)
    assert feared > 1.5
    assert after(FEARED - 1) == feared
    faded = [after(tasks) for tasks in (40, 60, 80, 1_000)]
    assert faded == sorted(faded, reverse=True)
    assert faded[-1] == pytest.approx(1.0, abs=0.2)
    one.learn(2.0, 1.0, ahead=81)
    assert after(0) == pytest.approx(faded[2], abs=0.1)


def test_at_first_all_models_have_the_same_weight() -> None:
    """The first prediction is the plain mean."""
    assert predicted(of(0.1, 0.3, 0.5)) == pytest.approx(0.3)


@pytest.mark.parametrize("best", [0.1, 0.5, 0.9])
def test_the_better_model_wins(best: float) -> None:
    """After thirty tasks the model that is right has nine tenths of the weight."""
    one, rng = of(0.1, 0.5, 0.9), Random(1)
    for _ in range(30):
        one.learn(2.0, best * rng.uniform(0.9, 1.1))
    assert predicted(one) == pytest.approx(best, abs=0.04)


def test_a_model_that_becomes_right_is_believed_again() -> None:
    """Errors fade: after forty tasks the model that became right decides."""
    one = of(0.1, 0.5, 0.9)
    for _ in range(200):
        one.learn(2.0, 0.1)
    for _ in range(40):
        one.learn(2.0, 0.5)
    assert predicted(one) == pytest.approx(0.5, abs=0.04)


def test_an_outlier_does_not_change_the_weights() -> None:
    """One time a hundred times as long moves the mean by less than a tenth of the models' distance."""
    one, rng = of(0.1, 0.5, 0.9), Random(2)
    for _ in range(50):
        one.learn(2.0, 0.1 * rng.uniform(0.9, 1.1))
    before = predicted(one)
    one.learn(2.0, 10.0)
    assert predicted(one) == pytest.approx(before, abs=0.04)


def test_if_all_models_agree_the_mean_is_exact() -> None:
    """This holds also for a time that binary fractions cannot represent."""
    for seconds in (0.1, 0.3, 1e-9):
        assert predicted(of(seconds, seconds, seconds)) == seconds


def test_no_time_is_below_zero() -> None:
    """A negative prediction of a model counts as 0."""
    assert predicted(of(-1.0, -2.0, -0.5)) == 0.0


@pytest.mark.parametrize("make", [Average, blind_average])
def test_the_spread_is_the_average_error(make: object) -> None:
    """For normal noise of 20 ms around a line, the spread is 20 ms within a third."""
    one, rng = make(50), Random(3)  # type: ignore[operator]
    for _ in range(400):
        size = rng.uniform(1, 5)
        one.learn(size, 0.2 + 0.1 * size + rng.gauss(0, 0.02))
    assert one.predict(2.0).spread_s == pytest.approx(0.02, rel=0.33)


def test_a_changed_link_is_followed_if_its_round_trip_explains_the_times() -> None:
    """If the round trip explains the times, the model that uses it wins, and a change is followed at once."""
    one, rng = Average(50), Random(4)
    for n in range(200):
        trip_s = 0.02 if n // 20 % 2 else 0.2
        size = rng.uniform(1, 5)
        one.learn(size, trip_s + 0.02 * size, Condition(round_trip_s=trip_s))
    assert predicted(one, Condition(round_trip_s=0.4)) == pytest.approx(0.44, rel=0.15)


def test_a_useless_feature_is_ignored() -> None:
    """If round trips are random, the model without them wins, and predictions stay near the true times."""
    one, rng = Average(50), Random(5)
    off = []
    for n in range(300):
        size, condition = rng.uniform(1, 5), Condition(round_trip_s=rng.choice([0.0, 0.5]))
        if n > 100:
            found = one.predict(size, 1, condition)
            assert found is not None
            off.append(abs(found.seconds - 0.1 * size))
        one.learn(size, 0.1 * size, condition)
    assert sum(off) / len(off) < 0.03, "the model that uses round trips is off by a quarter of a second"
