"""What the wrappers probe, hedge and budget change in a decision."""

from typing import Any

import pytest

from offboard.robot_client import policies
from offboard.robot_client.policies import Forecast, Hedge, Outlook, Probe
from offboard.robot_client.policies.prediction_errors import SPREADS_90
from offboard.robot_client.policies.probe import PROBE_EVERY
from offboard.robot_client.sites.runner import CLOUD, ONBOARD
from tests.outlooks import UNKNOWN, decide, known
from tests.policy_checks import EDGE, SILENT


@pytest.mark.parametrize(("age", "probed"), [(PROBE_EVERY - 1, False), (PROBE_EVERY, True)])
def test_a_site_without_tasks_is_probed(age: int, probed: bool) -> None:
    """The site that has gone longest without a task is probed after PROBE_EVERY tasks."""
    sites = {ONBOARD: known(0.1), CLOUD: known(0.2, age=age), EDGE: known(0.2, age=age - 1)}
    decision = decide("probe:greedy", sites)
    assert decision.site == ONBOARD
    assert decision.second == (Probe(CLOUD) if probed else None)
    assert ("cloud is probed" in decision.reason) == probed


@pytest.mark.parametrize("slower", [0.5, 1.0, 4.0])
def test_a_slow_robot_is_probed_as_often_as_it_has_the_time(slower: float) -> None:
    """Onboard runs at most a twentieth of the time for probes; of a server, only tasks are counted."""
    due = max(PROBE_EVERY, round(slower * PROBE_EVERY))
    for age, probed in ((due - 1, False), (due, True)):
        sites = {ONBOARD: known(0.5 * slower, age=age), CLOUD: known(0.5, cost=0.0)}
        assert (decide("probe:greedy", sites).second == Probe(ONBOARD)) == probed
    for age, probed in ((PROBE_EVERY - 1, False), (PROBE_EVERY, True)):
        sites = {ONBOARD: known(0.1), CLOUD: known(0.1 + slower, age=age)}
        assert (decide("probe:greedy", sites).second == Probe(CLOUD)) == probed


def test_a_probe_leaves_one_second_run_for_hedges() -> None:
    """If only one second run is allowed, a site is not probed, and the task may still be hedged."""
    sites = {ONBOARD: known(0.1), CLOUD: known(0.2, age=500)}
    forecast = Forecast(size=1.0, sites=sites, duplicates=1.0)
    assert policies.make("probe:greedy").decide(forecast).second is None
    assert isinstance(policies.make("hedge:probe:greedy").decide(forecast).second, Hedge)
    assert policies.make("probe:greedy").decide(forecast._replace(duplicates=2.0)).second == Probe(CLOUD)


@pytest.mark.parametrize("fields", [{"in_flight": 1}, {"condition": SILENT}], ids=["under way", "silent"])
def test_busy_and_silent_sites_are_not_probed(fields: dict[str, Any]) -> None:
    """A site that runs a task now is not probed, and a silent one is not, however old their times are."""
    sites = {ONBOARD: known(0.1), CLOUD: known(0.2, age=500, **fields)}
    assert decide("probe:greedy", sites).second is None


def test_with_few_errors_a_hedge_starts_when_95_percent_would_have_ended() -> None:
    """The cheapest other site starts SPREADS_90 spreads after the predicted time."""
    sites = {ONBOARD: known(0.5), CLOUD: known(0.2, spread_s=0.03), EDGE: known(0.4)}
    decision = decide("hedge:greedy", sites)
    assert decision.site == CLOUD
    assert decision.second == Hedge(EDGE, pytest.approx(0.2 + SPREADS_90 * 0.03))


@pytest.mark.parametrize(
    "sites",
    [
        {ONBOARD: known(0.2, spread_s=None), CLOUD: known(0.5)},
        {ONBOARD: known(0.2), CLOUD: UNKNOWN._replace(observations=50)},
        {ONBOARD: known(0.2), CLOUD: known(0.5, condition=SILENT)},
    ],
    ids=["spread unknown", "other unknown", "other silent"],
)
def test_a_task_is_not_hedged_with_too_little_knowledge(sites: dict[str, Outlook]) -> None:
    """A hedge needs the spread of the first site, and another site that answers and whose time is known."""
    assert decide("hedge:onboard", sites).second is None


def test_a_probe_goes_before_a_hedge() -> None:
    """If a site is due for a probe, it starts at once and is not planned as a hedge."""
    sites = {ONBOARD: known(0.4, age=2 * PROBE_EVERY), CLOUD: known(0.2)}
    assert decide("hedge:probe:greedy", sites).second == Probe(ONBOARD)
    second = decide("probe:hedge:greedy", sites).second
    assert second is not None
    assert second.site == ONBOARD


def test_the_warm_up_spares_the_sites_that_a_wrapper_leaves_out() -> None:
    """The first tasks run on all sites except those that the caps exclude."""
    sites = {ONBOARD: UNKNOWN, EDGE: UNKNOWN, CLOUD: known(0.1, bytes=500.0)}
    for rule in ("greedy", "paper"):
        decision = decide(f"budget:{rule}", sites, bytes_left=100.0)
        assert (decision.both, decision.spared) == (True, (CLOUD,))


@pytest.mark.parametrize(
    ("left", "site"),
    [({"bytes_left": 999.0}, ONBOARD), ({"bytes_left": 1000.0}, CLOUD), ({"joules_left": 0.4}, CLOUD)],
)
def test_a_site_beyond_the_caps_gets_no_task(left: dict[str, float], site: str) -> None:
    """A site that would take more bytes or joules than are left is not chosen."""
    sites = {ONBOARD: known(0.5, joules=0.5), CLOUD: known(0.1, bytes=1000.0, joules=0.1)}
    assert decide("budget:greedy", sites, **left).site == site


def test_a_task_runs_onboard_if_no_site_is_within_the_caps() -> None:
    """With nothing left to spend, every rule still answers the task."""
    sites = {ONBOARD: known(0.5, joules=0.5), CLOUD: known(0.1, joules=0.1)}
    for rule in policies.names():
        assert decide(f"budget:{rule}", sites, joules_left=-1.0).site == ONBOARD


def test_a_second_run_must_be_within_the_caps_too() -> None:
    """A hedge is planned only if both runs together are within the caps."""
    sites = {ONBOARD: known(0.5, joules=0.5), CLOUD: known(0.1, joules=0.2)}
    assert isinstance(decide("budget:hedge:greedy", sites, joules_left=0.7).second, Hedge)
    assert decide("budget:hedge:greedy", sites, joules_left=0.6).second is None


def test_the_first_wrapper_in_a_name_is_the_outermost() -> None:
    """Caps inside a probe do not hold for the probe; caps around it do."""
    sites = {ONBOARD: known(0.1), CLOUD: known(0.5, bytes=500.0, age=PROBE_EVERY)}
    assert decide("probe:budget:greedy", sites, bytes_left=100.0).second == Probe(CLOUD)
    assert decide("budget:probe:greedy", sites, bytes_left=100.0).second is None
