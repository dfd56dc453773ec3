"""What each rule chooses; the published rule is in test_paper.py."""

from collections import Counter
from collections.abc import Mapping

import pytest

from offboard.loadgen import rivals
from offboard.robot_client import policies
from offboard.robot_client.policies import Outlook, Policy
from offboard.robot_client.predictors.base import WARM_UP
from offboard.robot_client.sites.runner import CLOUD, ONBOARD
from tests.outlooks import UNKNOWN, decide, known
from tests.policy_checks import EDGE, SILENT

LINUCB, THOMPSON = rivals.policy("linucb"), rivals.policy("thompson")
DRAWN = 4_000  # decisions, for rules that draw


def shares(policy: Policy, sites: Mapping[str, Outlook]) -> dict[str, float]:
    """How often each site is chosen."""
    counts = Counter(decide(policy, sites).site for _ in range(DRAWN))
    return {site: count / DRAWN for site, count in counts.items()}


@pytest.mark.parametrize("rule", ["greedy", LINUCB, THOMPSON])
@pytest.mark.parametrize("best", [ONBOARD, CLOUD, EDGE])
def test_the_cheapest_of_three_sites_is_chosen(rule: str, best: str) -> None:
    """If one site certainly costs less than the others, every rule that compares costs chooses it."""
    sites = {ONBOARD: known(0.5), CLOUD: known(0.5), EDGE: known(0.5)} | {best: known(0.1)}
    assert decide(rule, sites).site == best


@pytest.mark.parametrize("rule", ["greedy", LINUCB])
def test_a_tie_stays_onboard(rule: str) -> None:
    """If all sites cost the same, the task is not sent anywhere."""
    assert decide(rule, {CLOUD: known(0.2), ONBOARD: known(0.2), EDGE: known(0.2)}).site == ONBOARD


def test_the_cost_counts_and_not_the_time() -> None:
    """The faster site loses if the objective says that it costs more."""
    sites = {ONBOARD: known(0.5, cost=1.0), CLOUD: known(0.1, cost=2.0)}
    assert decide("greedy", sites).site == ONBOARD


def test_linucb_prefers_the_site_that_is_less_known() -> None:
    """One standard error is subtracted from each cost, so the less known of two similar sites is tried."""
    sites = {ONBOARD: known(0.20, error_s=0.01), CLOUD: known(0.24, error_s=0.06)}
    assert decide(LINUCB, sites).site == CLOUD
    sites[CLOUD] = known(0.24, error_s=0.04)
    assert decide(LINUCB, sites).site == ONBOARD


def test_thompson_chooses_a_site_as_often_as_it_is_probably_cheaper() -> None:
    """N(0.2, 0.03) is below N(0.25, 0.04) with probability 84.1 %, and is chosen that often."""
    policy = policies.make(THOMPSON, seed=2)
    found = shares(policy, {ONBOARD: known(0.2, error_s=0.03), CLOUD: known(0.25, error_s=0.04)})
    assert found[ONBOARD] == pytest.approx(0.8413, abs=0.02), found


@pytest.mark.parametrize("rule", ["greedy", LINUCB, THOMPSON])
def test_all_sites_run_the_first_tasks(rule: str) -> None:
    """The warm-up lasts while a site has fewer than WARM_UP observations and no task under way."""
    for count, both in ((0, True), (WARM_UP - 1, True), (WARM_UP, False)):
        decision = decide(rule, {ONBOARD: known(0.1), CLOUD: known(0.2, observations=count, full=False)})
        assert decision.both == both, (count, decision)
    assert "cloud" in decide(rule, {ONBOARD: known(0.1), CLOUD: UNKNOWN}).reason
    under_way = UNKNOWN._replace(in_flight=1, under_way=True)
    assert not decide(rule, {ONBOARD: known(0.1), CLOUD: under_way}).both


@pytest.mark.parametrize("rule", ["greedy", LINUCB, THOMPSON])
def test_an_unknown_silent_site_gets_no_task(rule: str) -> None:
    """A site that does not answer heartbeats is neither warmed up nor chosen."""
    silent = UNKNOWN._replace(condition=SILENT)
    for onboard in (UNKNOWN, known(0.5)):
        decision = decide(rule, {ONBOARD: onboard, CLOUD: silent})
        assert (decision.site, decision.both) == (ONBOARD, False), decision
    decision = decide(rule, {ONBOARD: UNKNOWN, CLOUD: silent, EDGE: UNKNOWN})
    assert (decision.both, decision.spared) == (True, (CLOUD,))
