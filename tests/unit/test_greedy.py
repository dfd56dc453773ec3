"""What `greedy` chooses; the published rule is in test_paper.py."""

import pytest

from offboard.robot_client.predictors.base import WARM_UP
from offboard.robot_client.sites.runner import CLOUD, ONBOARD
from tests.outlooks import UNKNOWN, decide, known
from tests.policy_checks import EDGE, SILENT


@pytest.mark.parametrize("best", [ONBOARD, CLOUD, EDGE])
def test_the_cheapest_of_three_sites_is_chosen(best: str) -> None:
    """If one site certainly costs less than the others, it is chosen."""
    sites = {ONBOARD: known(0.5), CLOUD: known(0.5), EDGE: known(0.5)} | {best: known(0.1)}
    assert decide("greedy", sites).site == best


def test_a_tie_stays_onboard() -> None:
    """If all sites cost the same, the task is not sent anywhere."""
    assert decide("greedy", {CLOUD: known(0.2), ONBOARD: known(0.2), EDGE: known(0.2)}).site == ONBOARD


def test_the_cost_counts_and_not_the_time() -> None:
    """The faster site loses if the objective says that it costs more."""
    sites = {ONBOARD: known(0.5, cost=1.0), CLOUD: known(0.1, cost=2.0)}
    assert decide("greedy", sites).site == ONBOARD


def test_all_sites_run_the_first_tasks() -> None:
    """The warm-up lasts while a site has fewer than WARM_UP observations and no task under way."""
    for count, both in ((0, True), (WARM_UP - 1, True), (WARM_UP, False)):
        decision = decide("greedy", {ONBOARD: known(0.1), CLOUD: known(0.2, observations=count, full=False)})
        assert decision.both == both, (count, decision)
    assert "cloud" in decide("greedy", {ONBOARD: known(0.1), CLOUD: UNKNOWN}).reason
    under_way = UNKNOWN._replace(in_flight=1, under_way=True)
    assert not decide("greedy", {ONBOARD: known(0.1), CLOUD: under_way}).both


def test_an_unknown_silent_site_gets_no_task() -> None:
    """A site that does not answer heartbeats is neither warmed up nor chosen."""
    silent = UNKNOWN._replace(condition=SILENT)
    for onboard in (UNKNOWN, known(0.5)):
        decision = decide("greedy", {ONBOARD: onboard, CLOUD: silent})
        assert (decision.site, decision.both) == (ONBOARD, False), decision
    decision = decide("greedy", {ONBOARD: UNKNOWN, CLOUD: silent, EDGE: UNKNOWN})
    assert (decision.both, decision.spared) == (True, (CLOUD,))
