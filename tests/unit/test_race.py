"""When each site of a task starts, whose answer is used, and what happens to the other runs.

Time is virtual.
"""

from collections.abc import Callable

import pytest

from offboard.common.errors import (
    CannotCross,
    CloudBroken,
    CloudBusy,
    CloudTimeout,
    OffloadError,
    Overtaken,
    SiteClosed,
    TaskFailed,
)
from offboard.common.tasks import Task, kind_of, task
from offboard.robot_client.execution.race import Plan, Race, answer_of
from offboard.robot_client.policies import Hedge, Probe
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, Execution
from tests.virtual import VirtualClock, VirtualRunner

EDGE = "edge"
TIMEOUT_S = 2.0


@task("race_echo", size=lambda number: number)
def race_echo(number: int) -> int:
    return number


@task("race_once", size=lambda number: number, duplicate=False)
def race_once(number: int) -> int:
    return number


ECHO = kind_of(race_echo)


class Course:
    """A clock, three sites, and the calls that the race made."""

    def __init__(self) -> None:
        self.clock = VirtualClock()
        self.sites = {site: VirtualRunner(site, self.clock) for site in (ONBOARD, CLOUD, EDGE)}
        self.begun: list[tuple[str, float]] = []
        self.late: list[tuple[str, Execution]] = []
        self.allowed = True

    def run(self, plan: Plan, function: Callable[[int], int] = race_echo) -> tuple[Execution, ...]:
        race = Race(
            Task(kind_of(function), (7,), 7.0),
            self.sites,
            self.clock,
            TIMEOUT_S,
            begun=lambda site: self.begun.append((site, self.clock.now_s())),
            allowed=lambda _: self.allowed,
            late=lambda site, execution: self.late.append((site, execution)),
        )
        return race.run(plan)

    def take(self, **seconds: float | None) -> None:
        for site, takes in seconds.items():
            self.sites[site].takes = takes


@pytest.fixture
def course() -> Course:
    return Course()


def told(executions: tuple[Execution, ...]) -> list[tuple[str, str | None]]:
    return [(one.site, one.failure and type(one.failure).__name__) for one in executions]


def test_a_task_of_one_site_runs_there_alone(course: Course) -> None:
    """The race waits for the answer, and no other site starts."""
    course.take(cloud=0.3)
    (only,) = course.run(Plan((CLOUD,)))
    assert (only.value, only.seconds, course.clock.now_s()) == (7, 0.3, 0.3)
    assert course.begun == [(CLOUD, 0.0)]


@pytest.mark.parametrize(("onboard_s", "cloud_s"), [(0.1, 0.4), (0.4, 0.1), (0.2, 0.2)])
def test_a_plan_for_all_waits_for_every_run(course: Course, onboard_s: float, cloud_s: float) -> None:
    """The order in which the runs end does not matter; the faster answer is used."""
    course.take(onboard=onboard_s, cloud=cloud_s)
    executions = course.run(Plan((ONBOARD, CLOUD), all=True))
    assert [one.seconds for one in executions] == [onboard_s, cloud_s]
    assert course.clock.now_s() == max(onboard_s, cloud_s)
    assert answer_of(executions, ECHO).seconds == min(onboard_s, cloud_s)
    assert not course.late


def test_a_hedge_does_not_start_if_the_first_site_is_in_time(course: Course) -> None:
    """If the answer comes before the hedge is due, there is one execution."""
    course.take(cloud=0.3)
    assert told(course.run(Plan((CLOUD,), Hedge(ONBOARD, 0.4)))) == [(CLOUD, None)]
    assert course.clock.now_s() == 0.3


@pytest.mark.parametrize(
    ("onboard_s", "cloud_s", "used", "waited_s"), [(0.2, 1.0, ONBOARD, 0.6), (0.9, 0.5, CLOUD, 0.5)]
)
def test_the_first_answer_of_a_hedge_counts_and_the_other_run_is_cancelled(
    course: Course, onboard_s: float, cloud_s: float, used: str, waited_s: float
) -> None:
    """The second site starts when the hedge is due; the slower run is recorded as overtaken."""
    course.take(onboard=onboard_s, cloud=cloud_s)
    executions = course.run(Plan((CLOUD,), Hedge(ONBOARD, 0.4)))
    assert course.begun == [(CLOUD, 0.0), (ONBOARD, 0.4)]
    assert course.clock.now_s() == pytest.approx(waited_s)
    assert answer_of(executions, ECHO).site == used
    loser = ONBOARD if used == CLOUD else CLOUD
    (lost,) = (one for one in executions if one.site == loser)
    assert isinstance(lost.failure, Overtaken)
    assert lost.censored
    assert lost.seconds == pytest.approx(waited_s - (0.4 if loser == ONBOARD else 0.0))
    assert [one.args for one in course.sites[loser].cancelled] == [(7,)]
    assert not course.sites[used].cancelled


def test_a_late_site_is_hurried(course: Course) -> None:
    """A site is hurried when its hedge is due, even if the hedge is not allowed."""
    course.take(cloud=0.5, onboard=0.1)
    course.allowed = False
    course.run(Plan((CLOUD,), Hedge(ONBOARD, 0.2)))
    assert (course.sites[CLOUD].hurried_s, course.sites[ONBOARD].hurried_s) == ([0.2], [])
    course.run(Plan((ONBOARD,), Hedge(CLOUD, 0.2)))
    assert course.sites[ONBOARD].hurried_s == []


def test_the_second_site_starts_before_the_late_one_is_hurried(
    course: Course, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Hurrying takes CPU time, and a busy CPU may be the reason why the first site is late."""
    begun_by_then: list[list[str]] = []
    monkeypatch.setattr(
        course.sites[ONBOARD], "hurry", lambda: begun_by_then.append([site for site, _ in course.begun])
    )
    course.take(onboard=0.5, cloud=0.1)
    course.run(Plan((ONBOARD,), Hedge(CLOUD, 0.2)))
    assert begun_by_then == [[ONBOARD, CLOUD]]


def test_the_end_of_an_overtaken_run_is_reported_once(course: Course) -> None:
    """A run on a server ends at once and is censored; a run onboard cannot be stopped and ends later."""
    course.take(onboard=0.2, cloud=1.0)
    course.run(Plan((CLOUD,), Hedge(ONBOARD, 0.4)))
    assert [(site, one.seconds, one.ok) for site, one in course.late] == [(CLOUD, pytest.approx(0.6), False)]
    course.late.clear()
    course.take(onboard=0.9, cloud=0.5)
    course.run(Plan((CLOUD,), Hedge(ONBOARD, 0.4)))
    assert course.late == []
    course.clock.run_out()
    assert [(site, one.seconds, one.ok) for site, one in course.late] == [(ONBOARD, pytest.approx(0.9), True)]


def test_the_latest_run_starts_without_being_allowed(course: Course) -> None:
    """It is a fallback that does not wait for the failure; the first answer counts."""
    course.allowed = False
    course.take(cloud=1.0, onboard=0.1)
    executions = course.run(Plan((CLOUD,), latest=Hedge(ONBOARD, 0.3)))
    assert course.begun == [(CLOUD, 0.0), (ONBOARD, 0.3)]
    assert told(executions) == [(CLOUD, "Overtaken"), (ONBOARD, None)]
    assert course.clock.now_s() == pytest.approx(0.4)
    assert course.sites[CLOUD].hurried_s == [0.3]


@pytest.mark.parametrize(
    ("cloud_s", "begun"), [(0.2, [CLOUD]), (0.35, [CLOUD, EDGE]), (1.0, [CLOUD, EDGE, ONBOARD])]
)
def test_a_hedge_and_the_latest_run_each_start_in_time(
    course: Course, cloud_s: float, begun: list[str]
) -> None:
    """The hedge to a third site does not replace the run that must answer before a deadline."""
    course.take(cloud=cloud_s, edge=2.0, onboard=0.1)
    course.run(Plan((CLOUD,), Hedge(EDGE, 0.3), latest=Hedge(ONBOARD, 0.5)))
    assert [site for site, _ in course.begun] == begun


def test_a_latest_run_that_is_overdue_starts_at_once(course: Course) -> None:
    """Nothing is left of the time until it, and an earlier second run of the same site counts as it."""
    course.take(cloud=1.0, onboard=0.1)
    course.run(Plan((CLOUD,), latest=Hedge(ONBOARD, -0.1)))
    assert course.begun == [(CLOUD, 0.0), (ONBOARD, 0.0)]
    course.begun.clear()
    course.run(Plan((CLOUD,), Hedge(ONBOARD, 0.05), latest=Hedge(ONBOARD, 0.08)))
    assert [site for site, _ in course.begun] == [CLOUD, ONBOARD]


@pytest.mark.parametrize(("cloud_fails_s", "used"), [(0.1, ONBOARD), (0.5, ONBOARD)])
def test_a_failed_task_ends_a_warm_up_only_if_it_failed_on_both_sites(
    course: Course, cloud_fails_s: float, used: str
) -> None:
    """The site that is not known may lack a file; the other one runs the task anyway."""
    course.take(cloud=cloud_fails_s, onboard=0.3)
    course.sites[CLOUD].failure = TaskFailed("no")
    executions = course.run(Plan((ONBOARD, CLOUD), keep=True))
    assert answer_of(executions, ECHO).site == used
    assert course.clock.now_s() == pytest.approx(0.3)


def test_a_probe_starts_at_once_and_runs_on(course: Course) -> None:
    """The slower run of a probe is not cancelled, and its time is reported when it ends."""
    course.take(onboard=0.1, cloud=0.7)
    executions = course.run(Plan((ONBOARD,), Probe(CLOUD)))
    assert course.begun == [(ONBOARD, 0.0), (CLOUD, 0.0)]
    assert told(executions) == [(ONBOARD, None), (CLOUD, "Overtaken")]
    assert course.clock.now_s() == 0.1
    course.clock.run_out()
    assert [(site, one.seconds, one.ok) for site, one in course.late] == [(CLOUD, 0.7, True)]
    assert not course.sites[CLOUD].cancelled


@pytest.mark.parametrize("second", [Probe(ONBOARD), Hedge(ONBOARD, 0.4)])
def test_a_second_run_that_is_not_allowed_does_not_start(course: Course, second: Probe | Hedge) -> None:
    """The allowance is asked when the second run is due; if it refuses, no other site starts."""
    course.allowed = False
    course.take(onboard=0.1, cloud=1.0)
    assert told(course.run(Plan((CLOUD,), second))) == [(CLOUD, None)]
    assert course.begun == [(CLOUD, 0.0)]


@pytest.mark.parametrize("failure", [CloudBroken("gone"), CloudBusy("full"), CloudTimeout("late")])
@pytest.mark.parametrize("plan", [Plan((CLOUD,)), Plan((CLOUD,), Probe(EDGE)), Plan((CLOUD, EDGE), all=True)])
def test_the_task_runs_onboard_if_all_other_sites_failed(
    course: Course, plan: Plan, failure: OffloadError
) -> None:
    """Onboard starts when the last of the other sites has failed, and answers."""
    for site in (CLOUD, EDGE):
        course.sites[site].failure = failure
    course.take(cloud=0.3, edge=0.5, onboard=0.2)
    executions = course.run(plan)
    lost = [(CLOUD, type(failure).__name__), (EDGE, type(failure).__name__)]
    expected = lost if plan.second or plan.all else lost[:1]
    assert told(executions) == [*expected, (ONBOARD, None)]
    assert course.begun[-1] == (ONBOARD, 0.5 if len(expected) == 2 else 0.3)
    assert answer_of(executions, ECHO).value == 7


def test_a_failed_site_does_not_wait_for_its_hedge(course: Course) -> None:
    """If the first site fails before its hedge is due, the task runs onboard at once."""
    course.take(cloud=0.1)
    course.sites[CLOUD].failure = CloudBroken("gone")
    assert told(course.run(Plan((CLOUD,), Hedge(EDGE, 0.4)))) == [(CLOUD, "CloudBroken"), (ONBOARD, None)]
    assert course.begun == [(CLOUD, 0.0), (ONBOARD, 0.1)]


def test_one_failed_site_of_two_does_not_end_the_race(course: Course) -> None:
    """The race waits for the other site, and no third site starts."""
    course.take(cloud=0.5, onboard=3.0)
    course.sites[CLOUD].failure = CloudBroken("gone")
    executions = course.run(Plan((CLOUD,), Hedge(ONBOARD, 0.4)))
    assert told(executions) == [(CLOUD, "CloudBroken"), (ONBOARD, None)]
    assert course.clock.now_s() == 3.4
    assert not course.late


def test_a_site_that_never_answers_is_given_up(course: Course) -> None:
    """After the timeout of the task, the task runs onboard."""
    course.take(cloud=None)
    executions = course.run(Plan((CLOUD,)))
    assert told(executions) == [(CLOUD, "CloudTimeout"), (ONBOARD, None)]
    assert course.begun[-1] == (ONBOARD, TIMEOUT_S)


@pytest.mark.parametrize("plan", [Plan((CLOUD,), Probe(ONBOARD)), Plan((CLOUD,), Hedge(ONBOARD, 0.1))])
def test_a_failure_of_the_task_itself_ends_the_race(course: Course, plan: Plan) -> None:
    """The task would fail on every site, so the race does not wait, and onboard does not start."""
    course.take(cloud=0.2, onboard=5.0)
    course.sites[CLOUD].failure = TaskFailed("ValueError: no")
    executions = course.run(plan)
    assert course.clock.now_s() == 0.2
    assert isinstance(answer_of(executions, ECHO).failure, TaskFailed)
    assert told(executions) == [(CLOUD, "TaskFailed"), (ONBOARD, "Overtaken")]


@pytest.mark.parametrize(("started", "sites"), [(True, [CLOUD]), (False, [CLOUD, ONBOARD])])
def test_a_duplicate_false_task_is_not_run_again(course: Course, started: bool, sites: list[str]) -> None:
    """It runs onboard only if the failed site certainly never started it."""
    course.sites[CLOUD].failure = CloudBroken("gone")
    course.sites[CLOUD].fields = {"started": started}
    assert [one.site for one in course.run(Plan((CLOUD,)), race_once)] == sites


def test_the_answer_is_the_fastest_good_one() -> None:
    """Without a good answer: the failure of the task, else the last failure."""
    failed = TaskFailed("no")
    slow, fast = Execution(ONBOARD, 0.5, 1), Execution(CLOUD, 0.2, 1)
    lost = Execution(EDGE, 2.0, failure=CloudTimeout("late"))
    assert answer_of((lost, slow, fast), ECHO) is fast
    assert answer_of((lost, Execution(CLOUD, 0.1, failure=failed), slow), ECHO) is slow
    assert answer_of((Execution(CLOUD, 0.1, failure=failed), lost), ECHO).failure is failed
    assert answer_of((slow, Execution(CLOUD, 0.1, failure=CannotCross("a set"))), ECHO) is slow
    assert answer_of((lost,), ECHO) is lost


def test_a_closed_runner_counts_as_broken(course: Course) -> None:
    """A run that `close` cancelled counts as never started, and a closed onboard raises an error."""
    course.take(cloud=None)
    course.clock.after(0.1, lambda: [one.close() for one in course.sites.values()] and None)
    with pytest.raises(OffloadError, match="onboard is closed"):
        course.run(Plan((CLOUD,)))
    course = Course()
    course.take(onboard=None)
    course.clock.after(0.1, course.sites[ONBOARD].close)
    (only,) = course.run(Plan((ONBOARD,)))
    assert isinstance(only.failure, SiteClosed)
    assert not only.started
