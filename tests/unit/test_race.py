"""Who starts when, whose answer is used, and what becomes of the others, in virtual time."""

from collections.abc import Callable

import pytest

from offboard.common.errors import (
    BadValue,
    CloudBroken,
    CloudBusy,
    CloudTimeout,
    OffloadError,
    Overtaken,
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


class Course:
    """A clock, three sites, and what the race told of."""

    def __init__(self) -> None:
        self.clock = VirtualClock()
        self.sites = {site: VirtualRunner(site, self.clock) for site in (ONBOARD, CLOUD, EDGE)}
        self.begun: list[tuple[str, float]] = []
        self.late: list[tuple[str, Execution]] = []
        self.idle: list[list[str]] = []  # the sites that had begun by then
        self.allowed = True

    def run(self, plan: Plan, function: Callable[[int], int] = race_echo) -> tuple[Execution, ...]:
        race = Race(
            Task(kind_of(function), (7,), 7.0),
            self.sites,
            self.clock,
            TIMEOUT_S,
            begun=lambda site: self.begun.append((site, self.clock.now_s())),
            allowed=lambda: self.allowed,
            late=lambda site, execution: self.late.append((site, execution)),
            idle=lambda: self.idle.append([site for site, _ in self.begun]),
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


def test_one_site_is_waited_for(course: Course) -> None:
    """A task of one site runs there alone, until it answers."""
    course.take(cloud=0.3)
    (only,) = course.run(Plan((CLOUD,)))
    assert (only.value, only.seconds, course.clock.now_s()) == (7, 0.3, 0.3)
    assert course.begun == [(CLOUD, 0.0)]


@pytest.mark.parametrize(("onboard_s", "cloud_s"), [(0.1, 0.4), (0.4, 0.1), (0.2, 0.2)])
def test_all_are_waited_for_where_all_are_wanted(course: Course, onboard_s: float, cloud_s: float) -> None:
    """In whichever order they end; the answer is the faster one's."""
    course.take(onboard=onboard_s, cloud=cloud_s)
    executions = course.run(Plan((ONBOARD, CLOUD), all=True))
    assert [one.seconds for one in executions] == [onboard_s, cloud_s]
    assert course.clock.now_s() == max(onboard_s, cloud_s)
    assert answer_of(executions).seconds == min(onboard_s, cloud_s)
    assert not course.late


def test_a_hedge_does_not_start_where_the_first_is_in_time(course: Course) -> None:
    """An answer before the wait is over is the only execution."""
    course.take(cloud=0.3)
    assert told(course.run(Plan((CLOUD,), Hedge(ONBOARD, 0.4)))) == [(CLOUD, None)]
    assert course.clock.now_s() == 0.3


@pytest.mark.parametrize(
    ("onboard_s", "cloud_s", "used", "waited_s"), [(0.2, 1.0, ONBOARD, 0.6), (0.9, 0.5, CLOUD, 0.5)]
)
def test_of_a_hedge_the_first_answer_counts_and_the_other_is_given_up(
    course: Course, onboard_s: float, cloud_s: float, used: str, waited_s: float
) -> None:
    """The second starts when the wait is over; whoever is late is cancelled and recorded as overtaken."""
    course.take(onboard=onboard_s, cloud=cloud_s)
    executions = course.run(Plan((CLOUD,), Hedge(ONBOARD, 0.4)))
    assert course.begun == [(CLOUD, 0.0), (ONBOARD, 0.4)]
    assert course.clock.now_s() == pytest.approx(waited_s)
    assert answer_of(executions).site == used
    loser = ONBOARD if used == CLOUD else CLOUD
    (lost,) = (one for one in executions if one.site == loser)
    assert isinstance(lost.failure, Overtaken)
    assert lost.censored
    assert lost.seconds == pytest.approx(waited_s - (0.4 if loser == ONBOARD else 0.0))
    assert [one.args for one in course.sites[loser].cancelled] == [(7,)]
    assert not course.sites[used].cancelled


def test_what_is_done_meanwhile_is_done_once_the_first_have_begun(course: Course) -> None:
    """Before anything is waited for, and before a second site begins."""
    course.take(onboard=1.0, cloud=0.2)
    course.run(Plan((ONBOARD,), Hedge(CLOUD, 0.1)))
    assert course.idle == [[ONBOARD]]
    assert [site for site, _ in course.begun] == [ONBOARD, CLOUD]


def test_whoever_is_late_is_asked_whether_it_is_there(course: Course) -> None:
    """When its hedge is due, whether or not that may start; not where it was in time."""
    course.take(cloud=0.5, onboard=0.1)
    course.allowed = False
    course.run(Plan((CLOUD,), Hedge(ONBOARD, 0.2)))
    assert (course.sites[CLOUD].hurried_s, course.sites[ONBOARD].hurried_s) == ([0.2], [])
    course.run(Plan((ONBOARD,), Hedge(CLOUD, 0.2)))
    assert course.sites[ONBOARD].hurried_s == []


def test_the_second_starts_before_the_late_one_is_asked(
    course: Course, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To ask takes CPU, for want of which the first may be late."""
    begun_by_then: list[list[str]] = []
    monkeypatch.setattr(
        course.sites[ONBOARD], "hurry", lambda: begun_by_then.append([site for site, _ in course.begun])
    )
    course.take(onboard=0.5, cloud=0.1)
    course.run(Plan((ONBOARD,), Hedge(CLOUD, 0.2)))
    assert begun_by_then == [[ONBOARD, CLOUD]]


def test_what_comes_of_an_overtaken_run_is_told_once(course: Course) -> None:
    """A server's run ends at once, censored; one onboard, which cannot be stopped, when it is done."""
    course.take(onboard=0.2, cloud=1.0)
    course.run(Plan((CLOUD,), Hedge(ONBOARD, 0.4)))
    assert [(site, one.seconds, one.ok) for site, one in course.late] == [(CLOUD, pytest.approx(0.6), False)]
    course.late.clear()
    course.take(onboard=0.9, cloud=0.5)
    course.run(Plan((CLOUD,), Hedge(ONBOARD, 0.4)))
    assert course.late == []
    course.clock.run_out()
    assert [(site, one.seconds, one.ok) for site, one in course.late] == [(ONBOARD, pytest.approx(0.9), True)]


def test_a_probe_starts_at_once_and_runs_on(course: Course) -> None:
    """Its loser is not cancelled, and its time is told when it ends."""
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
    """The allowance is asked when the second would begin, and its no is kept to."""
    course.allowed = False
    course.take(onboard=0.1, cloud=1.0)
    assert told(course.run(Plan((CLOUD,), second))) == [(CLOUD, None)]
    assert course.begun == [(CLOUD, 0.0)]


@pytest.mark.parametrize("failure", [CloudBroken("gone"), CloudBusy("full"), CloudTimeout("late")])
@pytest.mark.parametrize("plan", [Plan((CLOUD,)), Plan((CLOUD,), Probe(EDGE)), Plan((CLOUD, EDGE), all=True)])
def test_the_task_runs_onboard_where_all_others_failed(
    course: Course, plan: Plan, failure: OffloadError
) -> None:
    """One site or several: onboard begins when the last of them is given up, and answers."""
    for site in (CLOUD, EDGE):
        course.sites[site].failure = failure
    course.take(cloud=0.3, edge=0.5, onboard=0.2)
    executions = course.run(plan)
    lost = [(CLOUD, type(failure).__name__), (EDGE, type(failure).__name__)]
    expected = lost if plan.second or plan.all else lost[:1]
    assert told(executions) == [*expected, (ONBOARD, None)]
    assert course.begun[-1] == (ONBOARD, 0.5 if len(expected) == 2 else 0.3)
    assert answer_of(executions).value == 7


def test_a_failed_first_does_not_wait_for_its_hedge(course: Course) -> None:
    """A site that fails before the second was due leads onboard at once, not after the wait."""
    course.take(cloud=0.1)
    course.sites[CLOUD].failure = CloudBroken("gone")
    assert told(course.run(Plan((CLOUD,), Hedge(EDGE, 0.4)))) == [(CLOUD, "CloudBroken"), (ONBOARD, None)]
    assert course.begun == [(CLOUD, 0.0), (ONBOARD, 0.1)]


def test_a_site_that_fails_does_not_end_the_race_of_two(course: Course) -> None:
    """The other one's answer is waited for; nothing else starts."""
    course.take(cloud=0.5, onboard=3.0)
    course.sites[CLOUD].failure = CloudBroken("gone")
    executions = course.run(Plan((CLOUD,), Hedge(ONBOARD, 0.4)))
    assert told(executions) == [(CLOUD, "CloudBroken"), (ONBOARD, None)]
    assert course.clock.now_s() == 3.4
    assert not course.late


def test_silence_ends_with_the_budget(course: Course) -> None:
    """A site that never answers is given up after the task's timeout."""
    course.take(cloud=None)
    executions = course.run(Plan((CLOUD,)))
    assert told(executions) == [(CLOUD, "CloudTimeout"), (ONBOARD, None)]
    assert course.begun[-1] == (ONBOARD, TIMEOUT_S)


@pytest.mark.parametrize("plan", [Plan((CLOUD,), Probe(ONBOARD)), Plan((CLOUD,), Hedge(ONBOARD, 0.1))])
def test_the_tasks_own_failure_ends_the_race(course: Course, plan: Plan) -> None:
    """It is the same everywhere: nobody waits for the other site, and nothing starts onboard."""
    course.take(cloud=0.2, onboard=5.0)
    course.sites[CLOUD].failure = TaskFailed("ValueError: no")
    executions = course.run(plan)
    assert course.clock.now_s() == 0.2
    assert isinstance(answer_of(executions).failure, TaskFailed)
    assert told(executions) == [(CLOUD, "TaskFailed"), (ONBOARD, "Overtaken")]


@pytest.mark.parametrize(("started", "sites"), [(True, [CLOUD]), (False, [CLOUD, ONBOARD])])
def test_a_task_that_runs_once_is_not_run_again(course: Course, started: bool, sites: list[str]) -> None:
    """duplicate=False: onboard takes it only where the site certainly never began."""
    course.sites[CLOUD].failure = CloudBroken("gone")
    course.sites[CLOUD].fields = {"started": started}
    assert [one.site for one in course.run(Plan((CLOUD,)), race_once)] == sites


def test_the_answer_is_the_fastest_good_one() -> None:
    """Of several the fastest; of none a value that cannot cross, then the task's failure, then the last."""
    bad, failed = BadValue("a set"), TaskFailed("no")
    slow, fast = Execution(ONBOARD, 0.5, 1), Execution(CLOUD, 0.2, 1)
    lost = Execution(EDGE, 2.0, failure=CloudTimeout("late"))
    assert answer_of((lost, slow, fast)) is fast
    assert answer_of((lost, Execution(CLOUD, 0.1, failure=failed), slow)) is slow
    assert answer_of((Execution(CLOUD, 0.1, failure=failed), lost)).failure is failed
    assert answer_of((slow, Execution(CLOUD, 0.1, failure=bad))).failure is bad
    assert answer_of((lost,)) is lost


def test_a_closed_runner_counts_as_broken(course: Course) -> None:
    """A run that `close` cancelled is a failure that never started; onboard, closed too, says so."""
    course.take(cloud=None)
    course.clock.after(0.1, lambda: [one.close() for one in course.sites.values()] and None)
    with pytest.raises(OffloadError, match="onboard is closed"):
        course.run(Plan((CLOUD,)))
    course = Course()
    course.take(onboard=None)
    course.clock.after(0.1, course.sites[ONBOARD].close)
    (only,) = course.run(Plan((ONBOARD,)))
    assert isinstance(only.failure, CloudBroken)
    assert not only.started
