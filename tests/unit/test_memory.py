"""What the memory of a kind learns from each execution, and what it then knows of a site."""

import math
from random import Random

import pytest

from offboard.common.errors import CloudBroken, CloudBusy, CloudError, CloudTimeout, Overtaken, TaskFailed
from offboard.common.tasks import kind_of, task
from offboard.robot_client import predictors
from offboard.robot_client.learning.kind import KindMemory
from offboard.robot_client.learning.site import WAYS_MAX
from offboard.robot_client.policies import Outlook, objectives
from offboard.robot_client.policies.energy import Energy
from offboard.robot_client.sites.own_cpu import LATE_MAX
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, UNMEASURED, Condition, Execution

SILENT = Condition(silent=True)


@task("memory_worked", size=lambda size: size, work=lambda result: result["work"])
def memory_worked(size: float) -> dict[str, float]:
    return {"work": 10 * size}


def memory(predictor: str = predictors.AVERAGE, *, shared_work: bool = False) -> KindMemory:
    return KindMemory(
        kind_of(memory_worked),
        lambda: predictors.make(predictor, 50),
        objective=objectives.Mean(),
        energy=Energy(),
        shared_work=shared_work,
    )


def outlook(
    of: KindMemory, site: str = CLOUD, condition: Condition = UNMEASURED, *, in_flight: int = 0
) -> Outlook:
    return of.site(site).outlook(1.0, condition, in_flight=in_flight, timeout_s=2.0)


def learn(
    of: KindMemory,
    execution: Execution,
    *,
    silent: bool = False,
    condition: Condition = UNMEASURED,
    in_flight: int = 0,
    beside: bool = False,
) -> None:
    site = of.site(execution.site)
    expected = outlook(of, execution.site, condition, in_flight=in_flight)
    of.count_task()
    site.learn(1.0, execution, expected, silent=silent, size=1.0, beside=beside)


def known(predictor: str = predictors.AVERAGE) -> KindMemory:
    """A memory that knows that the cloud takes 0.2 s."""
    one = memory(predictor)
    for _ in range(20):
        learn(one, Execution(CLOUD, 0.2))
    return one


def lost(failure: CloudError, seconds: float) -> Execution:
    return Execution(CLOUD, seconds, failure=failure, censored=isinstance(failure, CloudTimeout | Overtaken))


@pytest.mark.parametrize("failure", [CloudBusy("full"), CloudBroken("gone"), CloudTimeout("late")])
def test_a_site_that_refuses_at_once_does_not_look_fast(failure: CloudError) -> None:
    """The time until a refusal, or until a short timeout, does not change the predictions."""
    one = known()
    for n in range(50):
        learn(one, lost(failure, 0.004))
        assert outlook(one).failures == n + 1
    assert outlook(one).predicted_s == pytest.approx(0.2)
    fresh = memory()
    for failure in (CloudBusy("full"), CloudBroken("gone")):
        learn(fresh, lost(failure, 0.004))
    assert outlook(fresh).predicted_s is None


def test_a_plain_predictor_learns_every_lost_time() -> None:
    """The published rule learns the time until the run was given up, however short it is."""
    one = memory(predictors.LEAST_SQUARES)
    learn(one, lost(CloudBusy("full"), 0.004))
    assert outlook(one).predicted_s == 0.004


def test_a_lost_time_that_is_longer_than_expected_is_learnt() -> None:
    """After timeouts of 2 s the site is no longer expected to take 0.2 s."""
    one = known()
    for _ in range(30):
        learn(one, lost(CloudTimeout("late"), 2.0))
    predicted_s = outlook(one).predicted_s
    assert predicted_s is not None
    assert predicted_s > 1.0


def test_an_overtaken_run_takes_at_least_what_was_expected() -> None:
    """Stopped early it changes no prediction, stopped late its time is learnt; it is never a failure."""
    one = known()
    for _ in range(20):
        learn(one, lost(Overtaken("late"), 0.05))
    assert outlook(one).predicted_s == pytest.approx(0.2)
    assert outlook(one).failures == 0
    for _ in range(20):
        learn(one, lost(Overtaken("late"), 0.6))
    predicted_s = outlook(one).predicted_s
    assert predicted_s is not None
    assert predicted_s > 0.3


def width(of: KindMemory) -> float:
    """The width of the interval over the predicted time."""
    found = outlook(of)
    assert found.predicted_s is not None
    assert found.low_s is not None
    assert found.high_s is not None
    return (found.high_s - found.low_s) / found.predicted_s


def test_runs_that_are_stopped_after_their_interval_widen_it() -> None:
    """They missed the interval; a run that is stopped inside the interval says nothing."""
    rng, one = Random(1), memory()
    for _ in range(60):
        learn(one, Execution(CLOUD, 0.2 + rng.gauss(0, 0.01)))
    before = width(one)
    for _ in range(10):
        learn(one, lost(Overtaken("late"), 0.2))
    assert width(one) == pytest.approx(before, rel=0.1)
    for _ in range(10):
        learn(one, lost(Overtaken("late"), 0.4))
    assert width(one) > before


@pytest.mark.parametrize(
    ("predictor", "seconds", "run_s", "learnt_s"),
    [
        (predictors.AVERAGE, 0.3, None, 0.2),  # the answer may have been received late
        (predictors.AVERAGE, 0.1, None, 0.1),  # faster than predicted, even if it was received late
        (predictors.AVERAGE, 0.39, 0.3, 0.3),  # the server reports that it took longer
        ("least-squares", 0.3, None, 0.3),  # learns the measured time
    ],
)
def test_the_time_of_a_server_during_an_onboard_run_is_an_upper_bound(
    predictor: str, seconds: float, run_s: float | None, learnt_s: float
) -> None:
    """This holds for predictors of measured features; the age of the site starts anew in any case."""
    one = known(predictor)
    for _ in range(100):
        learn(one, Execution(CLOUD, seconds, run_s=run_s), beside=True)
        assert one.site(CLOUD).age == 0
    assert outlook(one).predicted_s == pytest.approx(learnt_s, rel=0.05)


def test_probes_that_were_received_late_still_lower_a_prediction() -> None:
    """The prediction becomes the time of the server, the round trip and the shortest of the last ways."""
    one, near = memory(), Condition(round_trip_s=0.03)
    for _ in range(20):
        learn(one, Execution(CLOUD, 0.05, run_s=0.003), condition=near)
    for n in range(40):
        seconds = 0.055 if n % WAYS_MAX else 0.035
        learn(one, Execution(CLOUD, seconds, run_s=0.003), condition=near, beside=True)
    assert outlook(one, condition=near).predicted_s == pytest.approx(0.035, rel=0.05)


def test_a_task_below_half_of_the_smallest_is_marked() -> None:
    """`smallest` is true only below SMALL of the smallest amount that the site ran."""
    site = memory().site(CLOUD)
    for ran, asked, smallest in ((None, 0.1, False), (1.0, 0.5, False), (1.0, 0.4, True), (0.4, 0.4, False)):
        if ran is not None:
            site.learn(ran, Execution(CLOUD, 0.2), None, silent=False, size=ran)
        found = site.outlook(asked, UNMEASURED, in_flight=0, timeout_s=2.0)
        assert found.smallest == smallest, (ran, asked)


def test_an_onboard_run_does_not_explain_a_very_late_answer() -> None:
    """A time above LATE_MAX times the prediction is learnt."""
    one = known()
    learn(one, Execution(CLOUD, 1.01 * LATE_MAX * 0.2), beside=True)
    found = outlook(one).predicted_s
    assert found is not None
    assert found > 0.2001


def test_failures_of_a_silent_site_teach_nothing() -> None:
    """A silent site is predicted to take the timeout, and its old time when it answers again."""
    one = known()
    for _ in range(30):
        learn(one, lost(CloudTimeout("late"), 2.0), silent=True, condition=SILENT)
        assert outlook(one, condition=SILENT).predicted_s == 2.0
    assert outlook(one).predicted_s == pytest.approx(0.2)


def test_a_failure_of_the_task_itself_changes_no_prediction() -> None:
    """It is no failure of the site, and the age of the site starts anew."""
    one = known()
    one.count_task()
    learn(one, Execution(CLOUD, 0.001, failure=TaskFailed("no")))
    assert outlook(one).predicted_s == pytest.approx(0.2)
    assert (outlook(one).age, outlook(one).failures) == (0, 0)


def test_age_counts_tasks_since_a_site_ran_one() -> None:
    """Each site has its own age."""
    one = known()
    learn(one, Execution(ONBOARD, 0.5))
    for _ in range(3):
        learn(one, Execution(ONBOARD, 0.5))
    assert (outlook(one, CLOUD).age, outlook(one, ONBOARD).age) == (4, 0)


def test_the_wait_for_own_tasks_is_predicted_but_not_learnt() -> None:
    """The tasks under way say how long the wait is, so only the run itself is learnt."""
    one = memory()
    for _ in range(10):
        learn(one, Execution(ONBOARD, 0.7, queue_s=0.5), in_flight=1)
    assert outlook(one, ONBOARD).predicted_s == pytest.approx(0.2)
    assert outlook(one, ONBOARD, Condition(wait_s=0.3)).predicted_s == pytest.approx(0.5)


def test_the_wait_for_the_cpu_is_learnt() -> None:
    """If no own task was before it, a run that waits for the CPU takes this long onboard."""
    one = memory()
    for _ in range(10):
        learn(one, Execution(ONBOARD, 0.7, queue_s=0.5))
    assert outlook(one, ONBOARD).predicted_s == pytest.approx(0.7)


def test_the_work_of_a_size_is_shared_by_all_sites() -> None:
    """A result from any site says the work of a size for all of them; a failed run does not."""
    one = memory(shared_work=True)
    assert one.amount(3.0) is None
    assert one.work_of_any([lost(CloudTimeout("late"), 2.0)]) is None
    told = one.work_of_any([lost(CloudTimeout("late"), 2.0), Execution(ONBOARD, 0.1, {"work": 30.0})])
    assert told == 30.0
    one.learn_size(3.0, told)
    assert one.amount(3.0) == 30.0
    assert memory().amount(3.0) == 3.0


def test_a_work_function_that_fails_costs_no_answer(caplog: pytest.LogCaptureFixture) -> None:
    """The failure is logged, and the work is unknown."""
    one = memory(shared_work=True)
    assert one.work_of_any([Execution(ONBOARD, 0.1, {})]) is None
    assert "cannot read the work" in caplog.text


def test_bytes_and_joules_are_the_usual_ones() -> None:
    """Bytes are a running mean; joules come from CPU time onboard, and from bytes on a server."""
    one = memory()
    for bytes_out in (100, 300):
        learn(one, Execution(CLOUD, 0.2, bytes_out=bytes_out, bytes_in=50))
    found = outlook(one)
    assert found.bytes == 250.0
    assert found.joules == pytest.approx(250 * Energy().radio_j_byte)
    learn(one, Execution(ONBOARD, 0.5, cpu_s=0.4))
    assert outlook(one, ONBOARD).joules == pytest.approx(0.4 * Energy().compute_w)
    assert math.isfinite(outlook(one, ONBOARD).cost or 0.0)


def test_times_of_a_server_under_load_of_the_robot_are_learnt_apart() -> None:
    """Predictions under load are those under load, and predictions after it are those before it."""
    one, loaded = known(), Condition(load=0.6)
    for _ in range(30):
        learn(one, Execution(CLOUD, 0.5), condition=loaded)
    assert outlook(one, condition=loaded).predicted_s == pytest.approx(0.5, rel=0.05)
    assert outlook(one).predicted_s == pytest.approx(0.2)


def test_the_round_trip_of_a_loaded_robot_is_not_used() -> None:
    """The last round trip without load is used, because the load would be counted twice otherwise."""
    one, quiet = memory(), Condition(round_trip_s=0.03)
    for _ in range(20):
        learn(one, Execution(CLOUD, 0.05), condition=quiet)
    for _ in range(5):
        learn(one, Execution(CLOUD, 0.15), condition=Condition(round_trip_s=0.2, load=0.8))
    for measured_s in (0.03, 0.1, 0.4):
        found = outlook(one, condition=Condition(round_trip_s=measured_s, load=0.8))
        assert found.predicted_s == pytest.approx(0.15, rel=0.05)
    assert outlook(one, condition=quiet).predicted_s == pytest.approx(0.05, rel=0.05)


def test_times_on_half_a_cpu_predict_times_on_a_whole_one() -> None:
    """The spread scales too; a predictor without features learns the measured time, as published."""
    one, half = memory(), Condition(capacity=0.5)
    for n in range(30):
        learn(one, Execution(ONBOARD, 0.2 + 0.01 * (n % 3 - 1)), condition=half)
    before, after = outlook(one, ONBOARD, half), outlook(one, ONBOARD)
    assert before.predicted_s == pytest.approx(0.2, rel=0.05)
    assert before.predicted_s == pytest.approx(2 * (after.predicted_s or 0.0))
    assert before.spread_s == pytest.approx(2 * (after.spread_s or 0.0))
    published = memory(predictors.LEAST_SQUARES)
    learn(published, Execution(ONBOARD, 0.2), condition=half)
    assert outlook(published, ONBOARD).predicted_s == pytest.approx(0.2)


def test_times_of_a_loaded_server_are_learnt_apart() -> None:
    """A loaded server is predicted to take longer from the start; its times without load stay the same."""
    one, alone = memory(), Condition(round_trip_s=0.03)
    busy = Condition(round_trip_s=0.03, server_load=1.0)
    for _ in range(20):
        learn(one, Execution(CLOUD, 0.05), condition=alone)
    assert (outlook(one, condition=busy).predicted_s or 0) > 1.2 * 0.05
    for _ in range(5):
        learn(one, Execution(CLOUD, 0.13), condition=busy)
    assert outlook(one, condition=busy).predicted_s == pytest.approx(0.13, rel=0.02)
    assert outlook(one, condition=alone).predicted_s == pytest.approx(0.05, rel=0.02)


def test_half_of_the_cpu_of_a_server_does_not_double_the_round_trip() -> None:
    """Times with half of the CPU and with all of it predict each other."""
    one = memory()
    for _ in range(20):
        learn(one, Execution(CLOUD, 0.07), condition=Condition(round_trip_s=0.03))
    held = Condition(round_trip_s=0.03, capacity=0.5)
    assert outlook(one, condition=held).predicted_s == pytest.approx(0.03 + 2 * 0.04, rel=0.02)
    for _ in range(20):
        learn(one, Execution(CLOUD, 0.11), condition=held)
    whole = outlook(one, condition=Condition(round_trip_s=0.03))
    assert whole.predicted_s == pytest.approx(0.07, rel=0.02)


def test_the_first_times_of_a_server_are_learnt_under_load_too() -> None:
    """Otherwise the warm-up would not end while the robot is loaded."""
    one = memory()
    for _ in range(20):
        learn(one, Execution(CLOUD, 0.2), condition=Condition(load=0.6))
    assert len(one.site(CLOUD).predictor) >= 10
    assert outlook(one).predicted_s == pytest.approx(0.2)
