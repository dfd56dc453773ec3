"""Calls with a deadline: when onboard starts next to a remote site, and how likely the pair answers in time.

Time is virtual.
"""

import math
from random import Random

import pytest

from offboard.common.tasks import task
from offboard.loadgen.simulation.model.stepped_offloader import SteppedOffloader
from offboard.robot_client import policies
from offboard.robot_client.learning.conformal import Conformal
from offboard.robot_client.policies import Decision, Forecast, Hedge, Outlook
from offboard.robot_client.policies.allowance import Allowance
from offboard.robot_client.policies.forecast import Quality
from offboard.robot_client.policies.objectives import HANDOVER_S, Deadline, Expected, by_deadline
from offboard.robot_client.policies.prediction_errors import NO_ERRORS, PredictionErrors
from offboard.robot_client.records.record import Record
from offboard.robot_client.settings import Settings
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, Condition
from tests.outlooks import known
from tests.virtual import VirtualClock, VirtualRunner

DEADLINE_S = 0.4
SLOWEST_S = 0.02
STALL_S = 1.5


def erring(*errors_s: float, of_s: float) -> PredictionErrors:
    """The errors of a site that was always predicted to take `of_s`; the first error is taken twice."""
    found = Conformal()
    for error_s in (errors_s[0], *errors_s):
        found.learn(of_s, of_s + error_s)
    return found.errors


def two_sites(
    onboard_s: float = 0.01, cloud_s: float = 0.1, *, late: int = 10, quality: float | None = None
) -> Forecast:
    """A steady onboard, and a cloud of which `late` of 100 runs stall; `quality`: of onboard, next to 1."""
    stalls = erring(*[0.0] * (100 - late), *[STALL_S] * late, of_s=cloud_s)
    sites = {
        CLOUD: known(cloud_s, errors=stalls),
        ONBOARD: known(onboard_s, errors=erring(*[0.0] * 100, of_s=onboard_s)),
    }
    if quality is not None:
        sites[CLOUD] = sites[CLOUD]._replace(quality=Quality(1.0))
        sites[ONBOARD] = sites[ONBOARD]._replace(quality=Quality(quality, 1.0 - quality))
    return Forecast(size=1.0, sites=sites, duplicates=0.0)


def decided(
    forecast: Forecast,
    policy: str = policies.DEFAULT,
    *,
    deadline_s: float = DEADLINE_S,
    slowest_s: float | None = SLOWEST_S,
) -> Decision:
    return policies.make(policy).decide(by_deadline(forecast, deadline_s, slowest_s=slowest_s))


def test_onboard_starts_when_its_slowest_run_and_a_tenth_still_fit() -> None:
    """It starts at the deadline minus 1.1 times the slowest of its last runs, with an empty allowance too."""
    decision = decided(two_sites(quality=0.7))
    assert (decision.site, decision.second) == (CLOUD, None)
    assert decision.latest == Hedge(ONBOARD, pytest.approx(DEADLINE_S - 1.1 * SLOWEST_S - HANDOVER_S))


def test_by_few_runs_onboard_may_take_three_times_as_long() -> None:
    """Before ten runs, it starts at the deadline minus three times the expected time."""
    forecast = two_sites(quality=0.7)
    sites = {**forecast.sites, ONBOARD: forecast.sites[ONBOARD]._replace(errors=NO_ERRORS)}
    decision = decided(forecast._replace(sites=sites))
    assert decision.latest == Hedge(ONBOARD, pytest.approx(DEADLINE_S - 3 * 0.01 - HANDOVER_S))


def test_a_larger_task_may_take_longer_than_the_slowest_smaller_one() -> None:
    """The expected time with its largest error counts if it is longer than every run so far."""
    forecast = two_sites(onboard_s=0.1, quality=0.5)
    decision = decided(forecast, slowest_s=SLOWEST_S)
    assert decision.latest is not None
    assert decision.latest.after_s == pytest.approx(DEADLINE_S - 1.1 * 0.1 - HANDOVER_S)


@pytest.mark.parametrize("policy", ["paper", "greedy", "probe:greedy", ONBOARD, CLOUD])
def test_only_a_policy_with_hedges_starts_onboard_in_time(policy: str) -> None:
    """All others decide as they do without a deadline."""
    assert not getattr(policies.make(policy), "pairs", False)
    assert decided(two_sites(), policy).latest is None


@pytest.mark.parametrize("policy", ["hedge:paper-with-heartbeats", "hedge:greedy", "hedge:cloud"])
def test_every_policy_with_hedges_starts_onboard_in_time(policy: str) -> None:
    """The rule behind the wrapper does not matter."""
    forecast = two_sites(cloud_s=0.005, quality=0.7)
    decision = decided(forecast, policy)
    assert decision.site == CLOUD
    assert decision.latest is not None


@pytest.mark.parametrize("wrapped", [policies.DEFAULT, f"budget:{policies.DEFAULT}", "probe:hedge:greedy"])
def test_wrappers_keep_what_the_hedges_promise(wrapped: str) -> None:
    """`budget` and `probe` around hedges, and the name of a policy, do not hide them."""
    assert policies.make(wrapped).pairs  # type: ignore[attr-defined]
    assert Settings(bytes_a_minute=1e9).make_policy(policies.DEFAULT).pairs  # type: ignore[attr-defined]


def test_a_task_that_runs_once_goes_to_the_likeliest_site() -> None:
    """Without a second run, the site that misses the deadline least is chosen, of whatever quality."""
    decision = decided(two_sites(late=60, quality=0.7), slowest_s=None)
    assert (decision.site, decision.latest) == (ONBOARD, None)
    assert decided(two_sites(late=60, quality=0.7)).site == CLOUD


def test_if_no_site_is_likely_the_likeliest_runs_alone() -> None:
    """Onboard would be too late by far, so it is not started for nothing."""
    decision = decided(two_sites(onboard_s=2.0, late=60))
    assert (decision.site, decision.latest) == (CLOUD, None)


def test_the_pair_is_likelier_than_each_site_alone() -> None:
    """The expectation of the remote site is that of the pair: both must be too late."""
    sites = by_deadline(two_sites(late=10), DEADLINE_S, slowest_s=SLOWEST_S).sites
    alone = by_deadline(two_sites(late=10), DEADLINE_S, slowest_s=None).sites
    assert alone[CLOUD].in_time == pytest.approx(0.9, abs=0.02)
    assert sites[CLOUD].in_time is not None
    assert sites[CLOUD].in_time > 0.999
    assert sites[ONBOARD].in_time == alone[ONBOARD].in_time


def test_equal_answers_come_from_the_faster_site() -> None:
    """A pair that is never late is no reason to send a task to a slower site of the same quality."""
    assert decided(two_sites(late=10)).site == ONBOARD


def test_a_hedge_is_planned_before_the_deadline_or_not_at_all() -> None:
    """A second run that begins after the deadline helps nobody."""
    late = erring(*[0.0] * 95, *[STALL_S] * 5, of_s=0.05)
    sites = {CLOUD: known(0.2, errors=erring(*[0.0] * 100, of_s=0.2)), ONBOARD: known(0.05, errors=late)}
    forecast = Forecast(size=1.0, sites=sites, duplicates=6.0)
    planned = [decided(forecast, f"hedge:{ONBOARD}", deadline_s=one).second for one in (0.04, 0.1, 0.3, 1.0)]
    print(planned)
    assert planned[0] is None
    assert planned[-1] is not None
    for deadline_s, second in zip((0.04, 0.1, 0.3, 1.0), planned, strict=True):
        assert second is None or (isinstance(second, Hedge) and second.after_s < deadline_s)


def test_a_better_answer_is_waited_for_until_onboard_must_start() -> None:
    """No hedge to a worse variant starts earlier, even if second runs are left."""
    decision = decided(two_sites(late=10, quality=0.7)._replace(duplicates=6.0))
    assert (decision.site, decision.second) == (CLOUD, None)


def test_caps_hold_for_the_run_onboard_too() -> None:
    """If the joules of both sites exceed the cap, onboard is not started."""
    forecast = two_sites(quality=0.7)
    sites = {site: one._replace(joules=0.6) for site, one in forecast.sites.items()}
    capped = decided(forecast._replace(sites=sites, joules_left=1.0), f"budget:{policies.DEFAULT}")
    assert capped.latest is None
    enough = decided(forecast._replace(sites=sites, joules_left=2.0), f"budget:{policies.DEFAULT}")
    assert enough.latest is not None


def test_a_silent_site_is_not_waited_for() -> None:
    """It should take its whole timeout, so the task runs onboard at once."""
    forecast = two_sites(late=0)
    silent = forecast.sites[CLOUD]._replace(predicted_s=2.0, condition=Condition(silent=True))
    assert decided(forecast._replace(sites={**forecast.sites, CLOUD: silent})).site == ONBOARD


def test_unknown_sites_cost_nothing_and_quality_no_seconds() -> None:
    """The cost of a call with a deadline replaces that of the objective."""
    sites = {ONBOARD: known(0.1, quality=Quality(0.5, 0.4), cost=9.0), CLOUD: Outlook()}
    found = by_deadline(Forecast(size=1.0, sites=sites), 0.5, slowest_s=None).sites
    whole = Expected(0.1, sites[ONBOARD].spread_s, 0.0, Quality(0.5))
    assert found[ONBOARD].cost == pytest.approx(Deadline(0.5).cost(whole, NO_ERRORS))
    assert found[ONBOARD].quality == Quality(0.5, 0.0)
    assert found[CLOUD].cost is None


def test_beyond_all_errors_a_miss_becomes_less_likely_with_the_distance() -> None:
    """It is never 0, and falls with the square of the distance from the prediction."""
    errors = erring(*[0.0] * 99, 0.1, of_s=1.0)
    near, far, farther = (errors.share_above(1.0, 1.0 + limit_s) for limit_s in (0.11, 1.0, 10.0))
    assert near is not None
    print(near, far, farther)
    assert near == pytest.approx(0.5 / 101, rel=0.3)
    assert far == pytest.approx(near * 0.11**2, rel=0.01)
    assert farther == pytest.approx(far / 100, rel=0.01)


def paired_onboard(number: int) -> int:
    return number


@task(
    "paired",
    size=lambda number: 1.0,  # noqa: ARG005
    quality={ONBOARD: 0.7, CLOUD: 1.0},
    variants={ONBOARD: paired_onboard},
)
def paired(number: int) -> int:
    return number


@task("paired_once", size=lambda number: 1.0, duplicate=False)  # noqa: ARG005
def paired_once(number: int) -> int:
    return number


class Robot:
    """A robot in virtual time, whose cloud stalls in one of eight runs; `records` are those of its calls."""

    def __init__(self, policy: str = policies.DEFAULT, settings: Settings | None = None) -> None:
        self.clock = VirtualClock()
        self.sites = {site: VirtualRunner(site, self.clock) for site in (CLOUD, ONBOARD)}
        self.random = Random(1)
        self.records: list[Record] = []
        made = settings or Settings()
        self.offload = SteppedOffloader(
            list(self.sites.values()),
            policy=made.make_policy(policy),
            memories=made.make_memories(policy),
            allowance=Allowance(0.1),
            clock=self.clock,
            observers=[self.records.append],
        )

    def call(self, number: int, deadline_s: float | None = DEADLINE_S, **options: str) -> Record:
        """One call, with its record."""
        stalls = self.random.random() < 1 / 8
        self.sites[CLOUD].takes = STALL_S if stalls else self.random.uniform(0.09, 0.11)
        self.sites[ONBOARD].takes = self.random.uniform(0.009, 0.011)
        self.offload.deadline_s = deadline_s
        assert self.offload(paired, number, **options) == number  # type: ignore[arg-type]
        return self.records[-1]


def test_no_deadline_is_missed_because_a_server_stalls() -> None:
    """In 300 calls, 1 in 8 of them stalled; most answers are the better ones, and no allowance is used."""
    robot = Robot()
    records = [robot.call(number) for number in range(300)]
    assert max(record.waited_s for record in records) <= DEADLINE_S
    assert sum(record.used == CLOUD for record in records) / 300 > 0.8
    assert robot.offload._allowance.duplicates > 5.0


def test_the_objective_deadline_keeps_it_for_every_call() -> None:
    """Without `deadline_s`, the deadline of the objective counts in the same way."""
    robot = Robot(settings=Settings(objective=Deadline(DEADLINE_S)))
    records = [robot.call(number, deadline_s=None) for number in range(200)]
    assert max(record.waited_s for record in records) <= DEADLINE_S
    assert sum(record.used == CLOUD for record in records) / 200 > 0.8


def test_a_pinned_call_and_a_task_that_runs_once_stay_on_one_site() -> None:
    """`where=` and `duplicate=False` are orders of the user."""
    robot = Robot()
    for number in range(40):
        robot.call(number)
    robot.random = Random(4)
    assert [one.site for one in robot.call(40, deadline_s=1.0, where=CLOUD).executions] == [CLOUD]
    robot.sites[CLOUD].takes, robot.sites[ONBOARD].takes = 0.1, 0.3
    for number in range(20):
        robot.offload(paired_once, number)
    assert all(len(record.executions) == 1 for record in robot.records[41:])


def test_the_trace_says_when_onboard_would_have_started() -> None:
    """A record names the latest start, whether or not it came to that."""
    robot = Robot()
    for number in range(60):
        record = robot.call(number)
    assert record.decision.latest is not None
    assert 0.3 < record.decision.latest.after_s < DEADLINE_S
    assert math.isfinite(record.decision.latest.after_s)
