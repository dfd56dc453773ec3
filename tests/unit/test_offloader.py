"""What the offloader does with good, late, failing and missing sites."""

import asyncio
import itertools
import threading
from collections.abc import Callable, Iterator

import pytest

from offboard.common.errors import (
    BadValue,
    CloudBroken,
    CloudBusy,
    CloudError,
    CloudTimeout,
    ConfigError,
    OffloadError,
    TaskFailed,
    UnknownTask,
)
from offboard.common.tasks import Task, task
from offboard.robot_client import policies, predictors
from offboard.robot_client.learning.memories import Memories
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.policies import Decision, Forecast, Probe
from offboard.robot_client.policies.allowance import DUPLICATES, Allowance
from offboard.robot_client.sites.onboard import OnboardRunner
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, UNMEASURED, Condition, Execution, Runner
from tests.fakes import ScriptedRunner
from tests.virtual import VirtualClock, VirtualRunner


class Scripted:
    """Decides as it is told."""

    def __init__(self) -> None:
        self.next = Decision(ONBOARD, "plain", "scripted")

    def decide(self, forecast: Forecast) -> Decision:  # noqa: ARG002
        return self.next


@task("add_one", size=lambda number: abs(number))
def add_one(number: int) -> int:
    if number < 0:
        raise ValueError("negative")
    return number + 1


@task("write_once", size=lambda: 0.0, duplicate=False)
def write_once() -> str:
    return "written"


def cloud_answers(
    seconds: float = 0.01, failure: Exception | None = None, **fields: object
) -> ScriptedRunner:
    def script(one: Task) -> Execution:
        value = None if failure else one.kind.function(*one.args)
        return Execution(CLOUD, seconds, value, failure, **fields)  # type: ignore[arg-type]

    return ScriptedRunner(CLOUD, script)


Make = Callable[..., Offloader]


@pytest.fixture
def make() -> Make:
    """Makes offloaders with window 2."""

    def factory(*runners: Runner, policy: str = CLOUD, **options: object) -> Offloader:
        return Offloader(
            list(runners),
            policy=policies.make(policy),
            memories=Memories(lambda: predictors.make(predictors.LEAST_SQUARES, 2)),
            **options,  # type: ignore[arg-type]
        )

    return factory


@pytest.mark.parametrize("failure", [CloudTimeout("late"), CloudBusy("full"), CloudBroken("gone")])
def test_a_failed_site_is_learnt_and_the_task_runs_onboard(make: Make, failure: CloudError) -> None:
    """No failure of the cloud reaches the caller; the lost time enters the cloud's window."""
    with make(cloud_answers(1.5, failure), OnboardRunner()) as offload:
        assert offload(add_one, 4) == 5
        record = offload.last
        assert record is not None
        assert [(one.site, one.ok) for one in record.executions] == [(CLOUD, False), (ONBOARD, True)]
        assert record.used == ONBOARD
        offload(add_one, 4, where=ONBOARD)
        assert offload.last is not None
        cloud = offload.last.sites[CLOUD]
        assert (cloud.predicted_s, cloud.failures) == (1.5, 1)


def test_a_run_in_place_of_a_failed_one_is_no_second_run(make: Make) -> None:
    """In an outage the allowance is not spent on answers, nor on what the caller has measured on both."""
    allowance = Allowance(first=0.0)
    with make(cloud_answers(0.1, CloudTimeout("late")), OnboardRunner(), allowance=allowance) as offload:
        for _ in range(10):
            assert offload(add_one, 4) == 5
        assert allowance.duplicates == pytest.approx(10 * DUPLICATES)
        offload(add_one, 4, where="both")
        assert allowance.duplicates == pytest.approx(11 * DUPLICATES)


def test_warm_up_ends_with_the_smallest_window_too(make: Make) -> None:
    """A window of 2 never holds so many observations: it is full, and that is enough."""
    sites: list[int] = []
    onboard = ScriptedRunner(ONBOARD, lambda one: Execution(ONBOARD, 0.5, one.args[0] + 1))
    with make(cloud_answers(0.1), onboard, policy="greedy") as offload:
        for _ in range(5):
            offload(add_one, 1)
            assert offload.last is not None
            sites.append(len(offload.last.executions))
    assert sites == [2, 2, 1, 1, 1]


def test_the_tasks_own_exception_is_raised_once_alike(make: Make) -> None:
    """An exception of the task is TaskFailed with its type and text, from either site, tried once."""
    cloud = cloud_answers(failure=TaskFailed("ValueError: negative"))
    with make(cloud, OnboardRunner()) as offload:
        for where in (ONBOARD, CLOUD):
            with pytest.raises(TaskFailed, match=r"^ValueError: negative$"):
                offload(add_one, -1, where=where)
            assert offload.last is not None
            assert len(offload.last.executions) == 1
            assert offload.last.used is None


def test_the_first_good_answer_of_two_is_used(make: Make) -> None:
    """Where both sites run, the faster good answer is the result and both times are learnt."""
    onboard = ScriptedRunner(ONBOARD, lambda one: Execution(ONBOARD, 0.5, one.args[0] + 1))
    with make(cloud_answers(0.1), onboard, policy="paper") as offload:
        assert offload(add_one, 1) == 2
        assert offload.last is not None
        assert offload.last.used == CLOUD
        offload(add_one, 1)
        assert {site: one.predicted_s for site, one in offload.last.sites.items()} == {
            CLOUD: 0.1,
            ONBOARD: 0.5,
        }


def test_both_sites_failing_in_one_way_or_another_still_answers(make: Make) -> None:
    """In warm-up a broken cloud costs nothing but its entry in the window."""
    with make(cloud_answers(0.2, CloudBroken("gone")), OnboardRunner(), policy="paper") as offload:
        assert offload(add_one, 1) == 2
        assert offload.last is not None
        assert len(offload.last.executions) == 2


def test_an_unavailable_site_is_no_candidate(make: Make) -> None:
    """While the server is not there, tasks run onboard without waiting and without learning about it."""
    cloud = cloud_answers()
    cloud.absent = "not connected"
    with make(cloud, OnboardRunner(), policy="paper") as offload:
        assert offload(add_one, 1) == 2
        assert offload.last is not None
        assert offload.last.decision.reason == "cloud: not connected"
        assert CLOUD not in offload.last.sites
        cloud.absent = None
        assert offload(add_one, 1) == 2
        assert offload.last.sites[CLOUD].predicted_s is None
    assert len(cloud.tasks) == 1


def test_where_pins_a_call(make: Make) -> None:
    """A call pinned onboard never leaves the robot, `both` runs on every site, an unknown site is refused."""
    cloud = cloud_answers()
    with make(cloud, OnboardRunner()) as offload:
        offload(add_one, 1, where=ONBOARD)
        assert cloud.tasks == []
        offload(add_one, 1, where="both")
        assert offload.last is not None
        assert [one.site for one in offload.last.executions] == [CLOUD, ONBOARD]
        with pytest.raises(ConfigError, match="'edge' is not one of cloud, onboard, both"):
            offload(add_one, 1, where="edge")


def test_a_task_that_must_not_run_twice_never_does(make: Make) -> None:
    """duplicate=False: one site in warm-up, each in turn; a lost answer is an error, a refused one is not."""
    cloud = cloud_answers(0.01)
    with make(cloud, OnboardRunner(), policy="paper") as offload:
        sites = []
        for _ in range(4):
            offload(write_once)
            assert offload.last is not None
            sites += [one.site for one in offload.last.executions]
        assert sites == [ONBOARD, CLOUD, ONBOARD, CLOUD]
        with pytest.raises(ConfigError, match="duplicate=False"):
            offload(write_once, where="both")


@pytest.mark.parametrize(("started", "answered"), [(True, False), (False, True)])
def test_a_lost_answer_of_a_single_run_task_is_raised(make: Make, started: bool, answered: bool) -> None:
    """A duplicate=False task falls back onboard only where it certainly did not start in the cloud."""
    with make(cloud_answers(2.0, CloudTimeout("late"), started=started), OnboardRunner()) as offload:
        if answered:
            assert offload(write_once) == "written"
        else:
            with pytest.raises(CloudTimeout):
                offload(write_once)


def test_a_value_that_cannot_cross_the_wire_is_one_clear_error(make: Make) -> None:
    """BadValue reaches the caller even where onboard could have answered."""
    with (
        make(cloud_answers(failure=BadValue("a set cannot cross the wire")), OnboardRunner()) as offload,
        pytest.raises(BadValue, match="set"),
    ):
        offload(add_one, 1, where="both")


@task("unique", size=lambda items: len(items))
def unique(items: list[int]) -> object:
    return set(items) if items else None


@pytest.mark.parametrize("where", [None, ONBOARD, CLOUD])
def test_the_first_call_says_what_cannot_cross(make: Make, where: str | None) -> None:
    """Argument or result, on whichever site it runs, with the server there or not: BadValue at once."""
    cloud = cloud_answers()
    cloud.absent = "not connected"
    with make(cloud, OnboardRunner()) as offload:
        with pytest.raises(BadValue, match=r"arguments of task unique: .*set"):
            offload(unique, {1, 2}, where=where)
        with pytest.raises(BadValue, match=r"result of task unique: .*set"):
            offload(unique, [1, 2], where=where)
        assert offload(unique, [], where=where) is None


def test_onboard_alone_takes_any_value(make: Make) -> None:
    """Where no other site is named nothing has to cross."""
    with make(OnboardRunner()) as offload:
        assert offload(unique, {1, 2}) == {1, 2}


def test_a_function_that_is_no_task_is_refused(make: Make) -> None:
    """The message says to decorate it."""
    with make(OnboardRunner()) as offload, pytest.raises(UnknownTask, match="decorate it with @task"):
        offload(len, "abc")


def test_keyword_arguments_and_wrong_calls_are_those_of_the_function(make: Make) -> None:
    """Keywords are bound as Python binds them, a wrong call is Python's own TypeError."""
    with make(OnboardRunner()) as offload:
        assert offload(add_one, number=2) == 3
        with pytest.raises(TypeError, match="missing a required argument"):
            offload(add_one)


def test_run_answers_in_asyncio(make: Make) -> None:
    """`await offload.run` gives the same result without blocking the loop."""

    async def together(offload: Offloader) -> list[int]:
        return await asyncio.gather(*(offload.run(add_one, n) for n in range(20)))

    with make(cloud_answers(), OnboardRunner()) as offload:
        assert asyncio.run(together(offload)) == list(range(1, 21))


def test_many_threads_lose_nothing(make: Make) -> None:
    """Eight threads, 400 calls: every answer is right and every record arrives once."""
    records: list[int] = []
    lock = threading.Lock()

    def note(record: object) -> None:
        with lock:
            records.append(record.i)  # type: ignore[attr-defined]

    wrong: list[int] = []

    def work(offload: Offloader, base: int) -> None:
        wrong.extend(n for n in range(base, base + 50) if offload(add_one, n) != n + 1)

    with make(cloud_answers(), OnboardRunner(), policy="paper", observers=[note]) as offload:
        threads = [threading.Thread(target=work, args=(offload, 100 * i)) for i in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert not wrong
    assert sorted(records) == list(range(400))


def test_onboard_must_be_among_the_sites() -> None:
    """An offloader without onboard, or with a site twice, is refused."""
    for runners in ([cloud_answers()], [OnboardRunner(), OnboardRunner()]):
        with pytest.raises(ConfigError, match="each site once, and 'onboard' among them"):
            Offloader(
                runners,
                policy=policies.make("paper"),
                memories=Memories(lambda: predictors.make("least-squares", 5)),
            )  # type: ignore[arg-type]


@pytest.mark.parametrize("timeout_s", [0.0, -1.0, float("nan"), float("inf"), 1e9])
def test_a_timeout_is_above_zero_and_bounded(make: Make, timeout_s: float) -> None:
    """No wait is endless, neither by the offloader's own timeout nor by that of a call."""
    with pytest.raises(ConfigError, match="must be above 0 and at most"):
        make(OnboardRunner(), timeout_s=timeout_s)
    with make(OnboardRunner()) as offload, pytest.raises(ConfigError, match="must be above 0"):
        offload(add_one, 1, timeout_s=timeout_s)


@task("stop_all", size=lambda: 0.0)
def stop_all() -> None:
    raise SystemExit(3)


def test_a_task_that_would_end_the_process_fails_alone(make: Make) -> None:
    """SystemExit and its like are the task's failure, onboard as in the cloud."""
    with make(OnboardRunner()) as offload:
        with pytest.raises(TaskFailed, match="SystemExit: 3"):
            offload(stop_all)
        assert offload(add_one, 1) == 2


def test_an_observer_that_fails_costs_no_answer(make: Make, caplog: pytest.LogCaptureFixture) -> None:
    """The answer is returned, the failure logged, the next observer called."""
    seen: list[object] = []

    def broken(record: object) -> None:
        raise ValueError(record)

    with make(OnboardRunner(), observers=[broken, seen.append]) as offload:
        assert offload(add_one, 1) == 2
    assert len(seen) == 1
    assert "failed on task 0" in caplog.text


def test_late_tasks_are_learnt_with_the_load_that_made_them_late() -> None:
    """A load that began after they were sent is looked for, and the quiet times stay what they were."""

    class Loaded(ScriptedRunner):
        def hurry(self) -> None:
            super().hurry()
            self.measured = Condition(load=1.0)

    home = Loaded(ONBOARD, lambda one: Execution(ONBOARD, 0.05, one.args))
    cloud = cloud_answers()
    takes: Iterator[float] = itertools.cycle([0.009, 0.01, 0.011])
    cloud.script = lambda one: Execution(CLOUD, next(takes), one.args)
    with Offloader(
        [home, cloud], policy=policies.make(CLOUD), memories=Memories(lambda: predictors.make("average", 50))
    ) as offload:
        for _ in range(60):
            offload(add_one, 2)
        for seconds in [0.1] * 6:
            home.measured = UNMEASURED  # as it was read before
            takes = iter([seconds])
            offload(add_one, 2)
        hurried, home.measured, takes = home.hurried, UNMEASURED, iter([0.01])
        offload(add_one, 2)
        assert hurried >= 6
        assert offload.last is not None
        assert offload.last.sites[CLOUD].predicted_s == pytest.approx(0.01, rel=0.2)


@pytest.mark.parametrize(
    ("busy", "seconds"), [(Condition(server_load=1.0), 0.05), (Condition(capacity=0.2), 0.05)]
)
def test_late_tasks_are_learnt_with_what_the_server_said_in_its_answer(
    busy: Condition, seconds: float
) -> None:
    """Others took its CPU, or it was held to a part of it, after the task was sent: alone it is as before."""
    cloud = cloud_answers()
    takes: Iterator[float] = itertools.cycle([0.009, 0.01, 0.011])

    def answer(one: Task) -> Execution:
        cloud.measured = says
        return Execution(CLOUD, next(takes), one.args)

    cloud.script, says = answer, UNMEASURED
    home = ScriptedRunner(ONBOARD, lambda one: Execution(ONBOARD, 0.05, one.args))
    with Offloader(
        [home, cloud], policy=policies.make(CLOUD), memories=Memories(lambda: predictors.make("average", 50))
    ) as offload:
        for _ in range(60):
            offload(add_one, 2)
        takes, says = itertools.repeat(seconds), busy
        for _ in range(6):
            cloud.measured = UNMEASURED  # as it was said before
            offload(add_one, 2)
        cloud.measured = says = UNMEASURED
        takes = itertools.repeat(0.01)
        offload(add_one, 2)
        assert offload.last is not None
        assert offload.last.sites[CLOUD].predicted_s == pytest.approx(0.01, rel=0.2)


@pytest.mark.parametrize(("capacity", "seconds"), [(0.2, 0.02), (1.0, 0.004)])
def test_odd_tasks_are_learnt_with_the_capacity_that_made_them_odd(capacity: float, seconds: float) -> None:
    """Held, or set free, since its CPU was last looked at, a robot is as quick as before for that CPU."""
    before = true = Condition(capacity=0.4)

    class Held(ScriptedRunner):
        def hurry(self) -> None:
            super().hurry()
            self.measured = true

    takes: Iterator[float] = itertools.cycle([0.009, 0.01, 0.011])
    home = Held(ONBOARD, lambda one: Execution(ONBOARD, next(takes), one.args))
    home.measured = before
    with Offloader(
        [home, cloud_answers()],
        policy=policies.make(ONBOARD),
        memories=Memories(lambda: predictors.make("average", 50)),
    ) as offload:
        for _ in range(60):
            offload(add_one, 2)
        takes, true = itertools.repeat(seconds), Condition(capacity=capacity)
        for _ in range(6):
            home.measured = before  # as it was read before
            offload(add_one, 2)
        home.measured, true, takes = before, before, itertools.repeat(0.01)
        offload(add_one, 2)
        assert offload.last is not None
        assert offload.last.sites[ONBOARD].predicted_s == pytest.approx(0.01, rel=0.2)


@pytest.mark.parametrize(("chosen", "second", "learnt"), [(ONBOARD, CLOUD, False), (CLOUD, None, True)])
def test_a_server_that_is_probed_beside_an_own_run_is_not_taken_for_slow(
    chosen: str, second: str | None, learnt: bool
) -> None:
    """The robot may have been slow to hear; where the task was sent to the server, its time counts."""
    policy, clock = Scripted(), VirtualClock()
    home, cloud = VirtualRunner(ONBOARD, clock, 0.02), VirtualRunner(CLOUD, clock, 0.04)
    with Offloader(
        [home, cloud], policy=policy, memories=Memories(lambda: predictors.make("average", 50)), clock=clock
    ) as offload:
        for _ in range(30):
            policy.next = Decision(CLOUD, "plain", "scripted")
            offload(add_one, 2)
        cloud.takes = 0.06
        for _ in range(30):
            policy.next = Decision(chosen, "probe", "scripted", second=Probe(second) if second else None)
            offload(add_one, 2)
            clock.run_out()
        policy.next = Decision(ONBOARD, "plain", "scripted")
        offload(add_one, 2)
        assert offload.last is not None
        found = offload.last.sites[CLOUD].predicted_s
        assert found is not None
        assert (found > 0.045) == learnt


def test_a_call_after_close_is_one_clear_error(make: Make) -> None:
    """A closed offloader says so instead of hanging."""
    offload = make(OnboardRunner())
    offload.close()
    with pytest.raises(OffloadError, match="closed"):
        offload(add_one, 1)


def test_close_closes_every_runner(make: Make) -> None:
    """Leaving the context closes all sites."""
    cloud = cloud_answers()
    with make(cloud, OnboardRunner()):
        pass
    assert cloud.closed
