"""When a second run is planned, when not, and what the reason says of it."""

from random import Random
from typing import Any

import pytest

from offboard.robot_client.learning.conformal import Conformal
from offboard.robot_client.policies import Hedge, Outlook
from offboard.robot_client.policies.forecast import Quality
from offboard.robot_client.policies.hedge import late_after_s
from offboard.robot_client.policies.prediction_errors import PredictionErrors
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, Condition
from tests.outlooks import UNKNOWN, decide, known

# Eight tasks were in time, one was 1 s late, and one 9 s: the example of `late_after_s`.
LATE = PredictionErrors((0.0,) * 8 + (1.0, 9.0), usual_s=1.0)


@pytest.mark.parametrize(("worth_s", "after_s"), [(2.0, 2.0), (7.9, 2.0), (8.1, 12.25), (60.0, 12.25)])
def test_the_example_of_the_rule_is_what_it_does(worth_s: float, after_s: float) -> None:
    """A task that was 1 s late needed 8 s more, so a second run that takes less than 8 s starts then."""
    assert late_after_s(known(1.0, errors=LATE), worth_s) == pytest.approx(after_s)


def test_a_task_is_late_when_waiting_costs_more_than_the_other_site() -> None:
    """Most tasks take about 1 s, some 20 s: a task is late soon after 1 s, unless 60 s are at stake."""
    conformal, random = Conformal(), Random(1)
    for n in range(100):
        conformal.learn(1.0, 20.0 if n % 25 == 24 else random.uniform(0.8, 1.2))
    site = known(1.0, errors=conformal.errors)
    after_s, at_last_s = late_after_s(site, 2.0), late_after_s(site, 60.0)
    assert after_s is not None
    assert 1.15 < after_s < 1.5
    assert at_last_s is not None
    assert at_last_s > 20.0, "no known task needed 60 s more"


def test_with_few_errors_a_task_is_late_beyond_its_spread() -> None:
    """1.645 standard deviations after the prediction; without a spread, nobody knows."""
    assert late_after_s(known(1.0), 0.1) == pytest.approx(1.0 + 1.645 * 0.1)
    assert late_after_s(known(1.0, spread_s=None), 0.1) is None
    assert late_after_s(UNKNOWN, 0.1) is None


def test_a_worse_second_run_starts_later_if_no_task_was_so_late() -> None:
    """By what the lost quality is worth; not if past tasks were late by more than the second run is worth."""
    calm = known(1.0, errors=PredictionErrors((0.0,) * 20, usual_s=1.0))
    assert late_after_s(calm, 0.6, 0.5) == pytest.approx((late_after_s(calm, 0.6) or 0.0) + 0.5)
    assert late_after_s(known(1.0), 0.6, 0.5) == pytest.approx((late_after_s(known(1.0), 0.6) or 0.0) + 0.5)
    late = known(1.0, errors=LATE)
    assert late_after_s(late, 2.0, 0.5) == late_after_s(late, 2.0)


def test_the_time_of_a_hedge_moves_with_the_error_of_the_prediction() -> None:
    """If the prediction itself may be wrong, a task is late later."""
    sure, unsure = (late_after_s(known(1.0, errors=LATE, error_s=error_s), 2.0) for error_s in (0.0, 1.0))
    assert sure is not None
    assert unsure is not None
    assert unsure > sure + 0.5


@pytest.mark.parametrize(
    ("sites", "fields", "said"),
    [
        ({ONBOARD: known(3.0), CLOUD: known(1.0, errors=LATE)}, {}, "onboard too after 2 s"),
        ({ONBOARD: known(3.0), CLOUD: known(1.0)}, {"duplicates": 0.9}, "no hedge: no second run is left"),
        (
            {ONBOARD: known(1.0), CLOUD: known(0.5, condition=Condition(silent=True), cost=9.0)},
            {},
            "no hedge: no second site answers",
        ),
        (
            {ONBOARD: known(1.0), CLOUD: UNKNOWN._replace(observations=6)},
            {},
            "no hedge: no second site is known",
        ),
        (
            {ONBOARD: known(1.0), CLOUD: known(2.0, quality=Quality(0.5, 1.0), cost=9.0)},
            {"deadline_s": 5.0},
            "no hedge: no second site is as good",
        ),
        (
            {ONBOARD: known(1.0, spread_s=None), CLOUD: known(2.0)},
            {},
            "no hedge: unknown when onboard is late",
        ),
        (
            {ONBOARD: known(1.0), CLOUD: known(2.0)},
            {"deadline_s": 1.1},
            "no hedge: onboard is late only after the deadline",
        ),
    ],
)
def test_the_reason_says_when_a_second_run_starts_or_why_none_does(
    sites: dict[str, Outlook], fields: dict[str, Any], said: str
) -> None:
    """Each decision for one site ends with the hedge, or with why there is none."""
    decision = decide("hedge:greedy", sites, **fields)
    assert decision.reason.endswith(f"; {said}")
    assert isinstance(decision.second, Hedge) is (" too after " in said)


def test_a_first_call_does_not_wait_for_a_server_alone() -> None:
    """While the first run onboard is under way, a call to a server that is hardly known starts there too."""
    sites = {ONBOARD: Outlook(in_flight=1, under_way=True), CLOUD: known(0.1, observations=1)}
    decision = decide("hedge:greedy", sites)
    assert (decision.site, decision.both) == (CLOUD, False)
    assert decision.second == Hedge(ONBOARD, pytest.approx(0.1 + 1.645 * 0.01))
    worse = sites[ONBOARD]._replace(quality=Quality(0.5, 0.5))
    later = decide("hedge:greedy", sites | {ONBOARD: worse}).second
    assert later == Hedge(ONBOARD, pytest.approx(0.1 + 1.645 * 0.01 + 0.5)), "the better answer should come"
    many = known(1.0, errors=LATE)
    assert decide("hedge:greedy", sites | {CLOUD: many}).second == Hedge(ONBOARD, 12.25), "later than any"
    failing = {ONBOARD: Outlook(failures=6), CLOUD: many}
    assert decide("hedge:greedy", failing).second == Hedge(ONBOARD, 12.25), "it may work again"
