"""The policy contract, one function per check; tests/unit/test_policies.py runs them on all policies.

Each check gets `make`, which makes a fresh policy, always with the same seed.
"""

import copy
import math
import random
from collections.abc import Callable, Iterable, Iterator

from offboard.robot_client.policies import Decision, Forecast, Hedge, Outlook, Policy
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, Condition

Make = Callable[[], Policy]

EDGE, FOG = "edge", "fog"
FORECASTS = 30
SILENT = Condition(silent=True)


def decides_among_the_sites_of_the_forecast(make: Make) -> None:
    """All sites of a decision are in the forecast, and the second run is on another site."""
    for forecast, decision in decisions(make(), forecasts()):
        assert decision.site in forecast.sites
        assert set(decision.spared) <= forecast.sites.keys() - {decision.site}
        if isinstance(decision.second, Hedge):
            assert 0 < decision.second.after_s < math.inf
        if decision.second is not None:
            assert decision.second.site in forecast.sites.keys() - {decision.site}
            assert not decision.both


def says_why(make: Make) -> None:
    """Every decision has a reason and the name of the rule."""
    for _, decision in decisions(make(), forecasts()):
        assert decision.reason
        assert decision.policy


def repeats_itself_for_a_seed(make: Make) -> None:
    """Two policies with the same seed make the same decisions."""
    once, again = (list(decisions(make(), forecasts())) for _ in range(2))
    assert once == again


def leaves_the_forecast_as_it_is(make: Make) -> None:
    """Deciding does not change the forecast."""
    policy = make()
    for forecast in forecasts():
        before = copy.deepcopy(forecast)
        policy.decide(forecast)
        assert forecast == before


def stays_onboard_without_other_sites(make: Make) -> None:
    """If onboard is the only site, the task runs there once."""
    for forecast, decision in decisions(make(), (one.only([ONBOARD]) for one in forecasts())):
        assert decision.site in forecast.sites
        assert (decision.site, decision.both, decision.second) == (ONBOARD, False, None)


def starts_no_second_run_on_a_silent_site(make: Make) -> None:
    """A site that does not answer heartbeats gets neither a probe nor a hedge."""
    for forecast, decision in decisions(make(), forecasts()):
        if decision.second is not None:
            assert not forecast.sites[decision.second.site].condition.silent


def starts_no_second_run_beyond_the_allowance(make: Make) -> None:
    """If no second run is allowed, none is planned."""
    for _, decision in decisions(make(), (one._replace(duplicates=0.99) for one in forecasts())):
        assert decision.second is None


def decides_before_anything_is_known(make: Make) -> None:
    """A policy decides even if nothing was learnt of any site."""
    for forecast, decision in decisions(make(), (unknown(one) for one in forecasts())):
        assert decision.site in forecast.sites
        assert not isinstance(decision.second, Hedge), "nothing says when a site is late"


def remembers_no_forecast(make: Make) -> None:
    """Rules that do not draw make the same decision for the same forecast, whatever came in between."""
    policy, probe = make(), next(iter(forecasts()))
    first = told(policy.decide(probe))
    for forecast in forecasts(seed=2):
        policy.decide(forecast)
    assert told(policy.decide(probe)) == first


CONTRACT: tuple[Callable[[Make], None], ...] = (
    decides_among_the_sites_of_the_forecast,
    says_why,
    repeats_itself_for_a_seed,
    leaves_the_forecast_as_it_is,
    stays_onboard_without_other_sites,
    starts_no_second_run_on_a_silent_site,
    starts_no_second_run_beyond_the_allowance,
    decides_before_anything_is_known,
    remembers_no_forecast,
)


def decisions(policy: Policy, asked: Iterable[Forecast]) -> Iterator[tuple[Forecast, Decision]]:
    for forecast in asked:
        yield forecast, told(policy.decide(forecast))


def told(decision: Decision) -> Decision:
    """The same decision with its reason in words, so that equal reasons compare as equal."""
    return decision._replace(why=decision.reason)


def forecasts(seed: int = 1) -> Iterator[Forecast]:
    """Random forecasts of one to four sites."""
    rng = random.Random(seed)
    for _ in range(FORECASTS):
        names = [ONBOARD, *rng.sample((CLOUD, EDGE, FOG), rng.randint(0, 3))]
        rng.shuffle(names)
        yield Forecast(
            size=10 ** rng.uniform(-3, 6),
            sites={name: outlook(rng, name) for name in names},
            last_site=rng.choice([None, ONBOARD, CLOUD, FOG]),
            duplicates=rng.choice([math.inf, 5.0, 1.0, 0.3, -7.0]),
            bytes_left=rng.choice([math.inf, 1e5, 300.0, -10.0]),
            joules_left=rng.choice([math.inf, 100.0, 0.5, -10.0]),
        )


def outlook(rng: random.Random, site: str) -> Outlook:
    away = site != ONBOARD
    condition = Condition(
        round_trip_s=rng.choice([None, rng.uniform(0, 0.5)]) if away else None,
        silent=away and rng.random() < 0.25,
        queue=rng.choice([0, 0, 3, 60]) if away else 0,
        load=0.0 if away else rng.random(),
        wait_s=rng.choice([0.0, 0.3]),
    )
    blank = Outlook(
        age=rng.choice([0, 1, 19, 20, 500]),
        failures=rng.choice([0, 0, 1, 3, 9, 10_000]),
        in_flight=rng.choice([0, 0, 2]),
        condition=condition,
    )
    if rng.random() < 0.2:
        return blank
    seconds = rng.choice([-0.01, 0.0, 10 ** rng.uniform(-4, 6)])  # a line may predict a time below 0
    spread = rng.choice([None, 0.0, 10 ** rng.uniform(-4, 6)])
    return blank._replace(
        predicted_s=seconds,
        spread_s=spread,
        full=rng.random() < 0.7,
        observations=rng.choice([1, 2, 3, 50]),
        low_s=None if spread is None else max(0.0, seconds - spread),
        high_s=None if spread is None else seconds + spread,
        error_s=rng.choice([None, 0.0, 0.2]),
        cost=rng.choice([None, seconds, rng.random()]),
        bytes=rng.choice([0.0, 200.0, 1e6]) if away else 0.0,
        joules=rng.choice([0.0, 0.3, 50.0]),
    )


def unknown(forecast: Forecast) -> Forecast:
    """The same forecast with nothing learnt of any site."""
    blank = {
        name: Outlook(age=one.age, failures=one.failures, condition=one.condition)
        for name, one in forecast.sites.items()
    }
    return forecast._replace(sites=blank)
