"""The cost that each objective gives a site, and what tasks take from the battery."""

import pytest

from offboard.common.errors import ConfigError
from offboard.robot_client.learning.conformal import Conformal
from offboard.robot_client.policies import objectives
from offboard.robot_client.policies.objectives import Energy, Expected
from offboard.robot_client.policies.prediction_errors import NO_ERRORS, PredictionErrors


def expected(seconds: float, spread_s: float | None = None, joules: float = 0.0) -> Expected:
    return Expected(seconds, spread_s, joules)


def erring(*errors_s: float) -> PredictionErrors:
    """The errors of a site that was always predicted to take 1 s; the first error is taken twice."""
    found = Conformal()
    for error_s in (errors_s[0], *errors_s):
        found.learn(1.0, 1.0 + error_s)
    return found.errors


def cost(name: str, of: Expected, errors: PredictionErrors = NO_ERRORS, **needs: float) -> float:
    return objectives.make(name, **needs).cost(of, errors)


def test_mean_is_the_prediction() -> None:
    """The cost is the predicted time; spread and errors do not matter."""
    assert cost("mean", expected(0.3, 0.9), erring(*[5.0] * 20)) == 0.3


def test_p95_is_the_time_that_95_percent_stay_below() -> None:
    """It comes from the errors, or from the spread while too few errors are known."""
    rare = erring(*[0.0] * 90, *[2.0] * 10)
    assert cost("p95", expected(1.0), rare) > 2.0
    assert cost("p95", expected(1.0), erring(*[0.0] * 100)) == pytest.approx(1.0)
    assert cost("p95", expected(0.3, 0.1)) == pytest.approx(0.3 + 0.1645)
    assert cost("p95", expected(0.3)) == 0.3


def test_a_steady_site_wins_by_its_tail() -> None:
    """A site with a larger mean and a smaller tail is better for p95 and worse for mean."""
    steady, wild = (expected(1.2), erring(*[0.0] * 50)), (expected(1.0), erring(*[-0.1, 1.0] * 25))
    assert cost("p95", *steady) < cost("p95", *wild)
    assert cost("mean", *steady) > cost("mean", *wild)


def test_deadline_is_the_probability_to_miss_it() -> None:
    """The site that misses less often wins, even if it is slower; between equals, the faster site wins."""
    sure, unsure = erring(*[0.0] * 50), erring(*[0.0] * 40, *[5.0] * 10)
    assert cost("deadline", expected(1.4), sure, deadline_s=2.0) < cost(
        "deadline", expected(1.0), unsure, deadline_s=2.0
    )
    assert cost("deadline", expected(1.4), sure, deadline_s=2.0) > cost(
        "deadline", expected(1.0), sure, deadline_s=2.0
    )


def test_with_few_errors_the_prediction_decides_about_the_deadline() -> None:
    """A site with a prediction after the deadline misses it, and one with a prediction before it does not."""
    assert cost("deadline", expected(0.6), deadline_s=0.5) > 1
    assert cost("deadline", expected(0.4), deadline_s=0.5) < 1e-3


def test_with_few_errors_the_spread_says_how_likely_a_miss_is() -> None:
    """Of two sites with the same prediction, the one with the larger spread costs more."""
    steady, unsteady = (cost("deadline", expected(0.4, one), deadline_s=0.5) for one in (0.05, 0.2))
    assert 1e-3 < steady < unsteady < 0.5


@pytest.mark.parametrize("seconds", [-0.5, -2.0])
def test_a_negative_prediction_is_no_negative_cost(seconds: float) -> None:
    """A line may predict a time below 0; it counts as 0."""
    assert cost("deadline", expected(seconds), deadline_s=0.5) == 0.0


def test_energy_weighs_joules_in_seconds() -> None:
    """If a joule is worth enough seconds, cheap waiting beats fast computing."""
    onboard, cloud = expected(0.2, joules=0.5), expected(0.4, joules=0.01)
    assert cost("energy", onboard, s_per_joule=0.1) < cost("energy", cloud, s_per_joule=0.1)
    assert cost("energy", onboard, s_per_joule=1.0) > cost("energy", cloud, s_per_joule=1.0)
    assert cost("energy", onboard, s_per_joule=2.0) == pytest.approx(0.2 + 2 * 0.5)


def test_metered_weighs_megabytes_in_seconds() -> None:
    """A megabyte is a million bytes, both ways together; with both weights, joules and bytes count."""
    sent = Expected(0.1, None, 0.5, bytes=20_000)
    assert cost("metered", sent, s_per_megabyte=10.0) == pytest.approx(0.1 + 0.2)
    assert cost("metered", sent, s_per_megabyte=10.0, s_per_joule=2.0) == pytest.approx(0.1 + 0.2 + 1.0)
    assert cost("energy", sent, s_per_joule=2.0) == pytest.approx(0.1 + 1.0)


@pytest.mark.parametrize(
    ("name", "needs", "says"),
    [
        ("median", {}, "objective 'median' is not one of mean, p95, deadline, energy"),
        ("deadline", {}, "needs a deadline above 0 s, not None"),
        ("deadline", {"deadline_s": 0.0}, "needs a deadline above 0 s, not 0.0"),
        ("energy", {}, "needs the seconds that a joule is worth, not None"),
        ("energy", {"s_per_joule": -1.0}, "not -1.0"),
        ("metered", {"s_per_joule": 1.0}, "needs the seconds that a megabyte is worth, not None"),
    ],
)
def test_an_objective_says_what_it_needs(name: str, needs: dict[str, float], says: str) -> None:
    """A wrong name or a missing setting is a ConfigError that says so."""
    with pytest.raises(ConfigError, match=says):
        objectives.make(name, **needs)


def test_energy_is_linear_in_cpu_seconds_waiting_and_bytes() -> None:
    """Computing costs CPU seconds, and offloading costs waiting and bytes."""
    energy = Energy(compute_w=2.0, idle_w=0.5, radio_j_byte=1e-6)
    assert energy.onboard_j(3.0) == 6.0
    assert energy.remote_j(2.0, 1e6) == 2.0
    assert Energy().onboard_j(1.0) == 0.9
    assert Energy().remote_j(100.0, 1000) == pytest.approx(0.007)


@pytest.mark.parametrize("field", ["compute_w", "idle_w", "radio_j_byte"])
def test_no_energy_setting_is_below_zero(field: str) -> None:
    """The error names the setting."""
    with pytest.raises(ConfigError, match=field):
        Energy(**{field: -1.0})
