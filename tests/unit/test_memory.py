"""What the memory of a kind learns from each execution, and what it then knows of a site."""

from random import Random

import pytest

from offboard.common.errors import (
    CloudBroken,
    CloudBusy,
    CloudError,
    CloudTimeout,
    Overtaken,
    SiteClosed,
    TaskFailed,
)
from offboard.common.tasks import kind_of, task
from offboard.robot_client import predictors
from offboard.robot_client.learning.kind import KindMemory
from offboard.robot_client.policies import Forecast, Outlook, objectives
from offboard.robot_client.policies.objectives import Energy
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, UNMEASURED, Condition, Execution, Sending

SILENT = Condition(silent=True)
RUN_S = 0.15  # of the server in `known`


@task("memory_worked", size=lambda size: size, work=lambda result: result["work"])
def memory_worked(size: float) -> dict[str, float]:
    return {"work": 10 * size}


def memory(predictor: str = predictors.PARTS, *, shared_work: bool = False) -> KindMemory:
    return KindMemory(
        kind_of(memory_worked),
        lambda: predictors.make(predictor, 50),
        shared_work=shared_work,
        measured=predictor == predictors.PARTS,
        s_per_quality=1.0,
    )


def outlook(
    of: KindMemory,
    site: str = CLOUD,
    condition: Condition = UNMEASURED,
    *,
    in_flight: int = 0,
    bytes_out: int = 100,
) -> Outlook:
    return of.site(site).outlook(1.0, condition, in_flight=in_flight, sending=Sending(bytes_out))


def joules(site: str, found: Outlook) -> float:
    """What the forecast of a robot with caps says of this site."""
    weighing = objectives.Weighing(objectives.Mean(), Energy())
    return weighing.weighed(Forecast(1.0, {site: found}), capped=True).sites[site].joules


def learn(
    of: KindMemory,
    execution: Execution,
    *,
    silent: bool = False,
    condition: Condition = UNMEASURED,
    in_flight: int = 0,
    bound: bool = False,
) -> None:
    site = of.site(execution.site)
    expected = outlook(of, execution.site, condition, in_flight=in_flight)
    of.count_task()
    site.learn(1.0, execution, expected, silent=silent, size=1.0, bound=bound)


def known(predictor: str = predictors.PARTS) -> KindMemory:
    """A memory that knows that the cloud takes 0.2 s, of which its run takes 0.15 s."""
    one = memory(predictor)
    for _ in range(20):
        learn(one, Execution(CLOUD, 0.2, queue_s=0.0, run_s=RUN_S, bytes_out=100))
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


def test_a_run_that_was_closed_says_nothing_of_its_site() -> None:
    """The list of servers changed while a second run was due: the server has not failed."""
    one = known()
    learn(one, lost(SiteClosed("closed"), 60.0))
    assert outlook(one).failures == 0
    assert outlook(one).predicted_s == pytest.approx(0.2)


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
        (predictors.PARTS, 0.3, RUN_S, 0.2),  # the answer may have been received late
        (predictors.PARTS, 0.17, RUN_S, 0.17),  # faster than predicted, even if it was received late
        (predictors.PARTS, 0.39, 0.3, 0.35),  # the server reports that its run took longer
        (predictors.LEAST_SQUARES, 0.3, RUN_S, 0.3),  # learns the measured time
    ],
)
def test_the_time_of_a_server_during_an_onboard_run_is_an_upper_bound(
    predictor: str, seconds: float, run_s: float, learnt_s: float
) -> None:
    """The network took at most the rest of the time; the age of the site starts anew in any case."""
    one = known(predictor)
    for _ in range(100):
        learn(one, Execution(CLOUD, seconds, queue_s=0.0, run_s=run_s, bytes_out=100), bound=True)
        assert one.site(CLOUD).age == 0
    assert outlook(one).predicted_s == pytest.approx(learnt_s, rel=0.05)


def test_a_time_that_was_perhaps_received_late_is_no_error_of_the_interval() -> None:
    """The interval of a server stays as narrow as it was."""
    one = known()
    before = outlook(one)
    for _ in range(20):
        learn(one, Execution(CLOUD, 0.6, queue_s=0.0, run_s=RUN_S, bytes_out=100), bound=True)
    assert outlook(one).high_s == pytest.approx(before.high_s, rel=0.05)


def test_the_wait_for_own_tasks_is_predicted_but_not_learnt() -> None:
    """The tasks under way say how long the wait is, so only the run itself is learnt."""
    one = memory()
    for _ in range(10):
        learn(one, Execution(ONBOARD, 0.7, queue_s=0.5, run_s=0.2), in_flight=1)
    assert outlook(one, ONBOARD).predicted_s == pytest.approx(0.2)
    assert outlook(one, ONBOARD, Condition(wait_s=0.3)).predicted_s == pytest.approx(0.5)


def test_the_wait_for_the_cpu_is_learnt() -> None:
    """If no own task was before it, a run that waits for the CPU takes this long onboard."""
    one = memory()
    for _ in range(10):
        learn(one, Execution(ONBOARD, 0.7, queue_s=0.5, run_s=0.2))
    assert outlook(one, ONBOARD).predicted_s == pytest.approx(0.7)


def test_bytes_are_those_of_the_task_and_of_the_usual_answer() -> None:
    """Bytes to send are those of the task itself, and bytes of answers a mean; joules come from both."""
    one = memory()
    for bytes_in in (40, 60):
        learn(one, Execution(CLOUD, 0.2, bytes_out=100, bytes_in=bytes_in))
    for bytes_out in (100, 700):
        found = outlook(one, bytes_out=bytes_out)
        assert found.bytes == bytes_out + 50
        assert joules(CLOUD, found) == pytest.approx((bytes_out + 50) * Energy().radio_j_byte)
    learn(one, Execution(ONBOARD, 0.5, cpu_s=0.4))
    for wait_s in (0.0, 3.0):  # waiting for other tasks takes no CPU time
        found = outlook(one, ONBOARD, Condition(wait_s=wait_s))
        assert joules(ONBOARD, found) == pytest.approx(0.4 * Energy().compute_w)


def test_the_joules_of_a_run_onboard_follow_its_amount() -> None:
    """A task of a tenth of the work takes a tenth of the CPU seconds, not those of the mean task."""
    one = memory()
    for n in range(40):
        amount, ran = (1.0, 0.5) if n % 2 else (0.1, 0.05)
        run = Execution(ONBOARD, ran, queue_s=0.0, run_s=ran, cpu_s=0.4 * ran)
        one.site(ONBOARD).learn(amount, run, None, silent=False, size=amount)
    for amount, ran in ((1.0, 0.5), (0.1, 0.05)):
        found = one.site(ONBOARD).outlook(amount, UNMEASURED, in_flight=0, sending=Sending(0))
        assert joules(ONBOARD, found) == pytest.approx(0.4 * ran * Energy().compute_w, rel=0.1)


def test_more_bytes_take_longer() -> None:
    """A task that sends ten times the bytes of the others is predicted by the rate of the link."""
    one = memory()
    for n in range(40):
        megabytes = 1.0 + n % 2
        seconds = 0.05 + megabytes / 5.0 + RUN_S
        learn(one, Execution(CLOUD, seconds, queue_s=0.0, run_s=RUN_S, bytes_out=int(megabytes * 1e6)))
    assert outlook(one, bytes_out=20_000_000).predicted_s == pytest.approx(0.05 + 4.0 + RUN_S, rel=0.1)
    assert outlook(one, bytes_out=0).predicted_s == pytest.approx(0.05 + RUN_S, rel=0.2)


def test_the_bytes_of_an_answer_are_those_of_earlier_answers() -> None:
    """An answer of 1 MB counts in the prediction of the next task; bytes of failed runs do not."""
    one = memory()
    for n in range(40):
        moved = 1_000_000 + 500_000 * (n % 2)
        seconds = 0.05 + moved / 5e6 + RUN_S
        learn(
            one, Execution(CLOUD, seconds, queue_s=0.0, run_s=RUN_S, bytes_out=moved - 10**6, bytes_in=10**6)
        )
        learn(one, lost(CloudBroken("gone"), 0.001))
    assert outlook(one, bytes_out=0).predicted_s == pytest.approx(0.05 + 0.2 + RUN_S, rel=0.05)


@pytest.mark.parametrize("predictor", [predictors.PARTS, predictors.LEAST_SQUARES])
def test_half_a_cpu_and_a_queue_count_only_in_the_parts_model(predictor: str) -> None:
    """The published rule predicts the measured times, whatever is measured of the site."""
    one = known(predictor)
    slow = Condition(capacity=0.5, queue=1)
    expected_s = 0.05 + 2 * RUN_S + RUN_S if predictor == predictors.PARTS else 0.2
    assert outlook(one, condition=slow).predicted_s == pytest.approx(expected_s, rel=0.02)
    if predictor == predictors.LEAST_SQUARES:
        return
    for _ in range(30):
        learn(one, Execution(CLOUD, 0.35, queue_s=0.0, run_s=2 * RUN_S, bytes_out=100), condition=slow)
    assert outlook(one).predicted_s == pytest.approx(0.2, rel=0.02)


def test_failures_of_a_silent_site_teach_nothing() -> None:
    """A silent site should take as long again as it was silent, and its old time when it answers again."""
    one = known()
    for _ in range(30):
        learn(one, lost(CloudTimeout("late"), 2.0), silent=True, condition=SILENT)
        assert outlook(one, condition=SILENT._replace(wait_s=1.5)).predicted_s == pytest.approx(1.7)
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
