"""The offloader answers every task, whether its sites are good, late, failing or missing."""

import asyncio
import re
import threading
from collections.abc import Callable

import pytest

from offboard.common.errors import (
    CannotCross,
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
from offboard.robot_client.policies.allowance import DUPLICATES, Allowance
from offboard.robot_client.sites.onboard import OnboardRunner
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, Execution, Runner
from tests.fakes import ScriptedRunner


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
def test_a_task_runs_onboard_if_the_cloud_fails(make: Make, failure: CloudError) -> None:
    """No failure of the cloud reaches the caller, and the cloud learns the lost time."""
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


def test_a_fallback_takes_nothing_from_the_allowance(make: Make) -> None:
    """Runs that replace a failed run, and runs that the caller measures on both sites, are free."""
    allowance = Allowance(first=0.0)
    with make(cloud_answers(0.1, CloudTimeout("late")), OnboardRunner(), allowance=allowance) as offload:
        for _ in range(10):
            assert offload(add_one, 4) == 5
        assert allowance.duplicates == pytest.approx(10 * DUPLICATES)
        offload(add_one, 4, where="both")
        assert allowance.duplicates == pytest.approx(11 * DUPLICATES)


def test_the_warm_up_ends_with_the_smallest_window_too(make: Make) -> None:
    """A window of 2 never holds WARM_UP observations, but a full window is enough."""
    sites: list[int] = []
    onboard = ScriptedRunner(ONBOARD, lambda one: Execution(ONBOARD, 0.5, one.args[0] + 1))
    with make(cloud_answers(0.1), onboard, policy="greedy") as offload:
        for _ in range(5):
            offload(add_one, 1)
            assert offload.last is not None
            sites.append(len(offload.last.executions))
    assert sites == [2, 2, 1, 1, 1]


def test_an_exception_of_the_task_is_raised_from_every_site_in_the_same_way(make: Make) -> None:
    """TaskFailed has the names of task and exception, and its text; the task ran once."""
    cloud = cloud_answers(failure=TaskFailed("task add_one: ValueError: negative"))
    with make(cloud, OnboardRunner()) as offload:
        for where in (ONBOARD, CLOUD):
            with pytest.raises(TaskFailed, match=r"^task add_one: ValueError: negative$"):
                offload(add_one, -1, where=where)
            assert offload.last is not None
            assert len(offload.last.executions) == 1
            assert offload.last.used is None


def test_the_first_good_answer_of_two_is_used(make: Make) -> None:
    """If both sites run a task, the faster good answer is the result, and both times are learnt."""
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


def test_a_broken_cloud_costs_no_answer_in_the_warm_up(make: Make) -> None:
    """While both sites run, the answer comes from onboard if the cloud is broken."""
    with make(cloud_answers(0.2, CloudBroken("gone")), OnboardRunner(), policy="paper") as offload:
        assert offload(add_one, 1) == 2
        assert offload.last is not None
        assert len(offload.last.executions) == 2


def test_an_unavailable_site_gets_no_task(make: Make) -> None:
    """While the server is not connected, tasks run onboard at once, and nothing is learnt of the server."""
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


@pytest.mark.parametrize("timeout_s", [-1.0, float("nan"), float("inf"), "5", True])
def test_a_wait_for_sites_lasts_a_time_that_is_possible(make: Make, timeout_s: float) -> None:
    """It does not wait for ever. With 0 it says at once why a site is absent."""
    cloud = cloud_answers()
    cloud.absent = "not connected"
    with make(cloud, OnboardRunner()) as offload:
        with pytest.raises(ConfigError, match="must be a number above 0"):
            offload.wait_for_sites(add_one, timeout_s)
        assert offload.wait_for_sites(add_one, 0)[CLOUD] == "not connected"


def test_where_pins_a_call(make: Make) -> None:
    """`onboard` stays on the robot, `both` runs on every site, and an unknown site is an error."""
    cloud = cloud_answers()
    with make(cloud, OnboardRunner()) as offload:
        offload(add_one, 1, where=ONBOARD)
        assert cloud.tasks == []
        offload(add_one, 1, where="both")
        assert offload.last is not None
        assert [one.site for one in offload.last.executions] == [CLOUD, ONBOARD]
        for wrong in ("edge", ["cloud"], 5):
            with pytest.raises(
                ConfigError, match=f"{re.escape(repr(wrong))} is not one of cloud, onboard, both"
            ):
                offload(add_one, 1, where=wrong)  # type: ignore[arg-type]


def test_a_task_declared_duplicate_false_never_runs_twice(make: Make) -> None:
    """In the warm-up its sites take turns, and it cannot be measured on both."""
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
def test_a_lost_answer_is_raised_if_the_task_may_have_run(make: Make, started: bool, answered: bool) -> None:
    """A duplicate=False task runs onboard only if it certainly did not start in the cloud."""
    with make(cloud_answers(2.0, CloudTimeout("late"), started=started), OnboardRunner()) as offload:
        if answered:
            assert offload(write_once) == "written"
        else:
            with pytest.raises(CloudTimeout):
                offload(write_once)


@task("unique", size=lambda items: len(items))
def unique(items: list[int]) -> object:
    return set(items) if items else None


@pytest.mark.parametrize("where", [None, CLOUD, "both"])
def test_what_cannot_be_sent_is_answered_onboard(
    make: Make, where: str | None, caplog: pytest.LogCaptureFixture
) -> None:
    """No call raises because of it, and the reason is logged once, also if a later call has it first."""
    refused = "arguments[0]: a set cannot be sent"
    cloud = cloud_answers()
    with make(cloud, OnboardRunner()) as offload:
        assert offload(add_one, 1, where=where) == 2
        assert caplog.messages == []
        cloud.script = cloud_answers(0.0, CannotCross(refused), started=False).script
        for number in range(3):
            assert offload(add_one, number, where=where) == number + 1
            assert offload.last is not None
            assert offload.last.used == ONBOARD
    assert caplog.messages == [
        f"add_one: only onboard can answer such a call: {refused}; remedy: change that value"
    ]


@pytest.mark.parametrize("where", [None, ONBOARD, CLOUD])
def test_the_first_call_says_which_value_cannot_be_sent(
    make: Make, where: str | None, caplog: pytest.LogCaptureFixture
) -> None:
    """Arguments and results are checked at once, on every site, also without the server."""
    cloud = cloud_answers()
    cloud.absent = "not connected"
    with make(cloud, OnboardRunner()) as offload:
        assert offload(unique, {1, 2}, where=where) == {1, 2}
        assert offload(unique, [1, 2], where=where) == {1, 2}
        assert offload(unique, {3}, where=where) == {3}
    start = "unique: only onboard can answer such a call: "
    assert [text.partition(" cannot be sent")[0] for text in caplog.messages] == [
        f"{start}arguments[0]: a value of type builtins.set",
        f"{start}result: a value of type builtins.set",
    ]


def test_a_value_that_changes_while_it_is_checked_breaks_no_call(
    make: Make, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The check of the first call logs whatever encoding raises."""

    def changing(*_: object, **__: object) -> None:
        raise RuntimeError("dictionary changed size during iteration")

    monkeypatch.setattr("offboard.robot_client.sites.absence.encode", changing)
    with make(cloud_answers(), OnboardRunner()) as offload:
        assert offload(unique, [1, 2]) == {1, 2}
    assert all("dictionary changed size" in text for text in caplog.messages)
    assert len(caplog.messages) == 2


def test_a_site_cannot_be_named_both() -> None:
    """`where="both"` would mean two things."""
    with pytest.raises(ConfigError, match="a site cannot be named 'both'"):
        Offloader.connect("tcp://127.0.0.1:9", sites={"both": "tcp://127.0.0.1:9"})


def test_a_robot_without_servers_takes_any_value(make: Make) -> None:
    """If onboard is the only site, no value has to be sent."""
    with make(OnboardRunner()) as offload:
        assert offload(unique, {1, 2}) == {1, 2}


def test_a_function_without_the_decorator_is_an_error(make: Make) -> None:
    """The message says to decorate the function with @task."""
    with make(OnboardRunner()) as offload, pytest.raises(UnknownTask, match="decorate it with @task"):
        offload(len, "abc")


def test_arguments_are_bound_as_in_python(make: Make) -> None:
    """Keyword arguments work, and a wrong call raises the TypeError of Python."""
    with make(OnboardRunner()) as offload:
        assert offload(add_one, number=2) == 3
        with pytest.raises(TypeError, match="missing a required argument"):
            offload(add_one)


def test_run_answers_in_asyncio(make: Make) -> None:
    """`await offload.run` gives the same result and does not block the event loop."""

    async def together(offload: Offloader) -> list[int]:
        return await asyncio.gather(*(offload.run(add_one, n) for n in range(20)))

    with make(cloud_answers(), OnboardRunner()) as offload:
        assert asyncio.run(together(offload)) == list(range(1, 21))


def test_many_threads_lose_nothing(make: Make) -> None:
    """In eight threads with 400 calls, every answer is right and every record arrives once."""
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
    """An offloader without onboard, or with the same site twice, is a ConfigError."""
    for runners in ([cloud_answers()], [OnboardRunner(), OnboardRunner()]):
        with pytest.raises(ConfigError, match="each site once, and 'onboard' among them"):
            Offloader(
                runners,
                policy=policies.make("paper"),
                memories=Memories(lambda: predictors.make("least-squares", 5)),
            )  # type: ignore[arg-type]


@pytest.mark.parametrize("timeout_s", [0.0, -1.0, float("nan"), float("inf"), 1e9, "3", [1.0]])
def test_a_timeout_is_above_zero_and_bounded(make: Make, timeout_s: float) -> None:
    """The timeout of an offloader and the timeout of a call must both be finite."""
    with pytest.raises(ConfigError, match="must be a number above 0, at most"):
        make(OnboardRunner(), timeout_s=timeout_s)
    with make(OnboardRunner()) as offload, pytest.raises(ConfigError, match="must be a number above 0"):
        offload(add_one, 1, timeout_s=timeout_s)


@task("stop_all", size=lambda: 0.0)
def stop_all() -> None:
    raise SystemExit(3)


def test_a_task_that_would_end_the_process_fails_alone(make: Make) -> None:
    """SystemExit in a task is TaskFailed, and the process goes on."""
    with make(OnboardRunner()) as offload:
        with pytest.raises(TaskFailed, match="SystemExit: 3"):
            offload(stop_all)
        assert offload(add_one, 1) == 2


def test_an_observer_that_fails_costs_no_answer(make: Make, caplog: pytest.LogCaptureFixture) -> None:
    """The answer is returned, the failure is logged, and the next observer is called."""
    seen: list[object] = []

    def broken(record: object) -> None:
        raise ValueError(record)

    with make(OnboardRunner(), observers=[broken, seen.append]) as offload:
        assert offload(add_one, 1) == 2
    assert len(seen) == 1
    assert "failed on task 0" in caplog.text


def test_a_call_after_close_is_one_clear_error(make: Make) -> None:
    """A closed offloader raises an error instead of waiting forever."""
    offload = make(OnboardRunner())
    offload.close()
    with pytest.raises(OffloadError, match="closed"):
        offload(add_one, 1)


def test_close_closes_every_runner(make: Make) -> None:
    """Leaving the context closes the runner of every site."""
    cloud = cloud_answers()
    with make(cloud, OnboardRunner()):
        pass
    assert cloud.closed
