"""The policy contract for every rule in every wrapping, and what each rule and wrapper does."""

from collections import Counter
from collections.abc import Callable, Mapping
from itertools import permutations
from typing import Any

import pytest

from offboard.common.errors import ConfigError
from offboard.robot_client import policies
from offboard.robot_client.policies import Decision, Forecast, Hedge, Outlook, Policy, Probe, rules, wrappers
from offboard.robot_client.policies.rules import EPSILON, WARM_UP
from offboard.robot_client.policies.wrappers import (
    BREAK_AFTER,
    BROKEN_FOR,
    BROKEN_MAX,
    MEASURED,
    PROBE_EVERY,
    SELDOM_MAX,
    STALE,
)
from offboard.robot_client.sites.runner import CLOUD, ONBOARD
from tests import policy_checks
from tests.policy_checks import EDGE, SILENT

WRAPPERS = ("probe", "hedge", "breaker", "budget")
WRAPPINGS = [":".join(some) for count in range(5) for some in permutations(WRAPPERS, count)]
DRAWN = 4_000  # of chance


def test_names_and_what_they_stand_for_agree() -> None:
    """What `--help` lists is what can be made."""
    assert tuple(rules.RULES) == policies.names()
    assert tuple(wrappers.WRAPPERS) == policies._WRAPPERS == WRAPPERS


@pytest.mark.parametrize("rule", policies.names())
@pytest.mark.parametrize("check", policy_checks.CONTRACT, ids=lambda check: check.__name__)
def test_contract(check: Callable[[policy_checks.Make], None], rule: str) -> None:
    """Every check of the contract holds for every rule in every order of wrappers."""
    for wrapping in WRAPPINGS:
        name = f"{wrapping}:{rule}".removeprefix(":")
        try:
            check(lambda name=name: policies.make(name, seed=3))
        except Exception as error:
            error.add_note(f"policy {name}")
            raise


def known(seconds: float, **fields: Any) -> Outlook:
    """A site of which enough is known; its spread is a tenth of its time."""
    return Outlook(
        **{"predicted_s": seconds, "spread_s": 0.1 * seconds, "full": True, "observations": 50} | fields
    )


UNKNOWN = Outlook()


def decide(policy: str | Policy, sites: Mapping[str, Outlook], **fields: Any) -> Decision:
    made = policies.make(policy) if isinstance(policy, str) else policy
    return made.decide(Forecast(size=1.0, sites=sites, **fields))


def shares(policy: Policy, sites: Mapping[str, Outlook]) -> dict[str, float]:
    """How often each site is chosen."""
    counts = Counter(decide(policy, sites).site for _ in range(DRAWN))
    return {site: count / DRAWN for site, count in counts.items()}


@pytest.mark.parametrize("rule", ["greedy", "hysteresis", "linucb", "thompson"])
@pytest.mark.parametrize("best", [ONBOARD, CLOUD, EDGE])
def test_the_cheapest_of_three_sites_is_chosen(rule: str, best: str) -> None:
    """Where one site is clearly cheaper, and that is certain, every rule that compares takes it."""
    sites = {ONBOARD: known(0.5), CLOUD: known(0.5), EDGE: known(0.5)} | {best: known(0.1)}
    assert decide(rule, sites).site == best


@pytest.mark.parametrize("rule", ["greedy", "hysteresis", "linucb"])
def test_a_tie_stays_onboard(rule: str) -> None:
    """Equal costs are no reason to send anything."""
    assert decide(rule, {CLOUD: known(0.2), ONBOARD: known(0.2), EDGE: known(0.2)}).site == ONBOARD


def test_cost_counts_and_not_time_where_there_is_one() -> None:
    """The faster site loses where the objective says that it costs more."""
    sites = {ONBOARD: known(0.5, cost=1.0), CLOUD: known(0.1, cost=2.0)}
    assert decide("greedy", sites).site == ONBOARD


@pytest.mark.parametrize(("cloud_s", "moves"), [(0.91, False), (0.89, True)])
def test_hysteresis_moves_for_a_tenth(cloud_s: float, moves: bool) -> None:
    """Another site must cost a tenth less than where the last task went; greedy moves for anything."""
    sites = {ONBOARD: known(1.0), CLOUD: known(cloud_s)}
    assert decide("hysteresis", sites, last_site=ONBOARD).site == (CLOUD if moves else ONBOARD)
    assert decide("hysteresis", sites, last_site=None).site == CLOUD
    assert decide("hysteresis", sites, last_site=EDGE).site == CLOUD, "it is not there any more"
    assert decide("greedy", sites, last_site=ONBOARD).site == CLOUD


def test_epsilon_tries_the_others_evenly() -> None:
    """One task in 1 / EPSILON goes elsewhere, half of them to each of two others."""
    policy = policies.make("epsilon", seed=5)
    found = shares(policy, {ONBOARD: known(0.1), CLOUD: known(0.2), EDGE: known(0.9)})
    assert found[CLOUD] == pytest.approx(EPSILON / 2, abs=0.01), found
    assert found[EDGE] == pytest.approx(EPSILON / 2, abs=0.01), found


def test_epsilon_tries_no_silent_site() -> None:
    """A random try is worth no timeout that is known beforehand."""
    policy = policies.make("epsilon", seed=5)
    found = shares(policy, {ONBOARD: known(0.1), CLOUD: known(2.0, condition=SILENT)})
    assert found == {ONBOARD: 1.0}


def test_linucb_prefers_what_is_less_known() -> None:
    """One standard error is taken off each cost: of two near sites the less known one is tried."""
    sites = {ONBOARD: known(0.20, error_s=0.01), CLOUD: known(0.24, error_s=0.06)}
    assert decide("linucb", sites).site == CLOUD
    sites[CLOUD] = known(0.24, error_s=0.04)
    assert decide("linucb", sites).site == ONBOARD


def test_thompson_chooses_as_often_as_it_believes() -> None:
    """The share of a site is the probability that it is cheaper: of N(0.2, 0.03) and N(0.25, 0.04) 84.1 %."""
    policy = policies.make("thompson", seed=2)
    found = shares(policy, {ONBOARD: known(0.2, error_s=0.03), CLOUD: known(0.25, error_s=0.04)})
    assert found[ONBOARD] == pytest.approx(0.8413, abs=0.02), found


@pytest.mark.parametrize("rule", ["greedy", "hysteresis", "epsilon", "linucb", "thompson"])
def test_all_sites_run_until_each_has_its_first_observations(rule: str) -> None:
    """Warm-up lasts while a site has fewer than WARM_UP, unless tasks that will tell are there already."""
    for count, both in ((0, True), (WARM_UP - 1, True), (WARM_UP, False)):
        decision = decide(rule, {ONBOARD: known(0.1), CLOUD: known(0.2, observations=count, full=False)})
        assert decision.both == both, (count, decision)
    assert "cloud" in decide(rule, {ONBOARD: known(0.1), CLOUD: UNKNOWN}).reason
    under_way = UNKNOWN._replace(in_flight=1)
    assert not decide(rule, {ONBOARD: known(0.1), CLOUD: under_way}).both


@pytest.mark.parametrize("rule", ["greedy", "hysteresis", "epsilon", "linucb", "thompson"])
def test_a_silent_site_is_neither_warmed_up_nor_chosen(rule: str) -> None:
    """Nothing is known of it, and its heartbeats say that nothing would be."""
    silent = UNKNOWN._replace(condition=SILENT)
    for onboard in (UNKNOWN, known(0.5)):
        decision = decide(rule, {ONBOARD: onboard, CLOUD: silent})
        assert (decision.site, decision.both) == (ONBOARD, False), decision
    decision = decide(rule, {ONBOARD: UNKNOWN, CLOUD: silent, EDGE: UNKNOWN})
    assert (decision.both, decision.spared) == (True, (CLOUD,))


@pytest.mark.parametrize(("age", "probed"), [(PROBE_EVERY - 1, False), (PROBE_EVERY, True)])
def test_a_site_without_news_is_probed_at_once(age: int, probed: bool) -> None:
    """After PROBE_EVERY tasks the stalest other site runs the task too, from its beginning."""
    sites = {ONBOARD: known(0.1), CLOUD: known(0.2, age=age), EDGE: known(0.2, age=age - 1)}
    decision = decide("probe:greedy", sites)
    assert decision.site == ONBOARD
    assert decision.second == (Probe(CLOUD) if probed else None)
    assert ("cloud is probed" in decision.reason) == probed


@pytest.mark.parametrize(
    ("onboard_s", "after"), [(0.11, 1.1**2 * MEASURED), (0.15, 1.5**2 * MEASURED), (2.0, SELDOM_MAX)]
)
def test_a_slow_robot_is_probed_more_seldom(onboard_s: float, after: float) -> None:
    """By the square of how much slower it is than the chosen site, up to SELDOM_MAX."""
    for age, probed in ((PROBE_EVERY * after - 1, False), (PROBE_EVERY * after + 1, True)):
        sites = {ONBOARD: known(onboard_s, age=age), CLOUD: known(0.1)}
        assert (decide("probe:greedy", sites).second == Probe(ONBOARD)) == probed


def test_a_task_smaller_than_all_it_ran_probes_the_robot() -> None:
    """At once, however slow it is expected to be; a server is tried no sooner for that."""
    onboard, cloud = known(0.3, age=1, smallest=True), known(0.1)
    assert decide("probe:greedy", {ONBOARD: onboard, CLOUD: cloud}).second == Probe(ONBOARD)
    onboard, cloud = known(0.1), known(0.3, age=1, smallest=True)
    assert decide("probe:greedy", {ONBOARD: onboard, CLOUD: cloud}).second is None


def test_a_probe_leaves_a_second_run_to_hedges() -> None:
    """With one second run left a stale site is not probed, and the task may still be hedged."""
    sites = {ONBOARD: known(0.1), CLOUD: known(0.2, age=500)}
    forecast = Forecast(size=1.0, sites=sites, duplicates=1.0)
    assert policies.make("probe:greedy").decide(forecast).second is None
    assert isinstance(policies.make("hedge:probe:greedy").decide(forecast).second, Hedge)
    assert policies.make("probe:greedy").decide(forecast._replace(duplicates=2.0)).second == Probe(CLOUD)


@pytest.mark.parametrize("fields", [{"in_flight": 1}, {"condition": SILENT}], ids=["under way", "silent"])
def test_some_sites_are_not_probed(fields: dict[str, Any]) -> None:
    """Not one that runs a task just now, nor a silent one, however stale."""
    sites = {ONBOARD: known(0.1), CLOUD: known(0.2, age=500, **fields)}
    assert decide("probe:greedy", sites).second is None


def test_a_hedge_starts_at_two_deviations() -> None:
    """The cheapest other site starts when the chosen one is 2 sd later than its mean."""
    sites = {ONBOARD: known(0.5), CLOUD: known(0.2, spread_s=0.03), EDGE: known(0.4)}
    decision = decide("hedge:greedy", sites)
    assert decision.site == CLOUD
    assert decision.second == Hedge(EDGE, pytest.approx(0.2 + 2 * 0.03))


@pytest.mark.parametrize(
    "sites",
    [
        {ONBOARD: known(0.2, spread_s=None), CLOUD: known(0.5)},
        {ONBOARD: known(0.2), CLOUD: UNKNOWN._replace(observations=50)},
        {ONBOARD: known(0.2), CLOUD: known(0.5, condition=SILENT)},
    ],
    ids=["spread unknown", "other unknown", "other silent"],
)
def test_what_is_not_known_cannot_be_hedged(sites: dict[str, Outlook]) -> None:
    """Without a spread, or without another site whose time is known and that answers, nobody else starts."""
    assert decide("hedge:onboard", sites).second is None


def test_a_probe_goes_before_a_hedge() -> None:
    """In either order a stale site is probed at once and not hedged to later."""
    sites = {ONBOARD: known(0.5, age=STALE), CLOUD: known(0.2)}
    assert decide("hedge:probe:greedy", sites).second == Probe(ONBOARD)
    second = decide("probe:hedge:greedy", sites).second
    assert second is not None
    assert second.site == ONBOARD


@pytest.mark.parametrize("more", range(6))
def test_a_broken_site_rests_twice_as_long_each_time(more: int) -> None:
    """Three failures in a row: no task for 10 tasks; each further one doubles that, up to 160."""
    failures, rests = BREAK_AFTER + more, min(BROKEN_MAX, BROKEN_FOR * 2**more)
    for age, site in ((0, ONBOARD), (rests - 1, ONBOARD), (rests, CLOUD)):
        sites = {ONBOARD: known(0.5), CLOUD: known(0.1, failures=failures, age=age)}
        assert decide("breaker:greedy", sites).site == site, (failures, age)
    almost = {ONBOARD: known(0.5), CLOUD: known(0.1, failures=BREAK_AFTER - 1)}
    assert decide("breaker:greedy", almost).site == CLOUD


def test_a_broken_onboard_is_still_there() -> None:
    """Onboard is where tasks go when nothing else is left, whatever failed there."""
    sites = {ONBOARD: known(0.1, failures=99), CLOUD: known(0.5, failures=99)}
    assert decide("breaker:greedy", sites).site == ONBOARD


def test_warm_up_spares_what_a_wrapper_leaves_out() -> None:
    """All sites run but those that are broken, or that the caps leave nothing for."""
    sites = {ONBOARD: UNKNOWN, EDGE: UNKNOWN, CLOUD: known(0.1, failures=9)}
    assert decide("breaker:greedy", sites).spared == (CLOUD,)
    assert decide("breaker:paper", sites).spared == (CLOUD,)
    sites[CLOUD] = known(0.1, bytes=500.0)
    decision = decide("budget:greedy", sites, bytes_left=100.0)
    assert (decision.both, decision.spared) == (True, (CLOUD,))


@pytest.mark.parametrize(
    ("left", "site"),
    [({"bytes_left": 999.0}, ONBOARD), ({"bytes_left": 1000.0}, CLOUD), ({"joules_left": 0.4}, CLOUD)],
)
def test_caps_leave_out_what_they_do_not_cover(left: dict[str, float], site: str) -> None:
    """A site that would take more bytes or joules than are left gets no task."""
    sites = {ONBOARD: known(0.5, joules=0.5), CLOUD: known(0.1, bytes=1000.0, joules=0.1)}
    assert decide("budget:greedy", sites, **left).site == site


def test_where_no_cap_is_met_the_task_runs_onboard() -> None:
    """With nothing left at all it is still answered."""
    sites = {ONBOARD: known(0.5, joules=0.5), CLOUD: known(0.1, joules=0.1)}
    for rule in policies.names():
        assert decide(f"budget:{rule}", sites, joules_left=-1.0).site == ONBOARD


def test_a_second_run_must_be_within_the_caps_too() -> None:
    """A hedge is planned where both runs together are covered, and left out where they are not."""
    sites = {ONBOARD: known(0.5, joules=0.5), CLOUD: known(0.1, joules=0.2)}
    assert isinstance(decide("budget:hedge:greedy", sites, joules_left=0.7).second, Hedge)
    assert decide("budget:hedge:greedy", sites, joules_left=0.6).second is None


def test_the_first_wrapper_of_a_name_is_the_outermost() -> None:
    """A probe around a breaker reaches the site that the breaker leaves out; one inside it does not."""
    sites = {ONBOARD: known(0.5), CLOUD: known(0.1, failures=9, age=50)}
    assert decide("probe:breaker:greedy", sites).second == Probe(CLOUD)
    assert decide("breaker:probe:greedy", sites).second is None


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("gredy", "'gredy' is not one of paper, onboard, cloud, greedy"),
        ("", "'' is not one of paper"),
        ("hedge", "'hedge' is not one of paper"),
        ("hegde:greedy", "'hegde' is not one of probe, hedge, breaker, budget, once each"),
        ("hedge:hedge:greedy", "'hedge' is not one of probe, hedge, breaker, budget, once each"),
        (":greedy", "'' is not one of probe, hedge, breaker, budget, once each"),
    ],
)
def test_a_wrong_name_is_one_line(name: str, says: str) -> None:
    """It names what is wrong and all that there is."""
    with pytest.raises(ConfigError) as refused:
        policies.make(name)
    assert says in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("name", policies.names())
def test_every_rule_has_a_predictor_that_there_is(name: str) -> None:
    """What a policy is meant with can be made, in any wrapping."""
    from offboard.robot_client import predictors

    assert predictors.make(policies.predictor_of(f"hedge:probe:{name}"), 5).predict(1.0) is None
    assert policies.predictor_of(f"hedge:{name}") == policies.predictor_of(name)
