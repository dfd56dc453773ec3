"""The states of workers: how many there are, which times they cost, and what a failing setup leads to."""

import inspect
import threading
import time
from collections.abc import Iterator
from contextvars import Context
from types import SimpleNamespace

import pytest

from offboard.common import task_states
from offboard.common.errors import ConfigError, Overtaken, TaskFailed
from offboard.common.task_call import check_wanted
from offboard.common.task_states import SETUP_AGAIN_S, TaskStates
from offboard.common.tasks import Task, kind_of, task
from offboard.robot_client.execution.race import Plan, Race
from offboard.robot_client.sites import onboard
from offboard.robot_client.sites.absence import Absent, wait_for_sites
from offboard.robot_client.sites.onboard import OnboardRunner
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, Execution, Lasting
from offboard.robot_client.sites.waiting import SystemClock
from tests.fakes import ScriptedRunner

WAIT_S = 5.0
SETUP_S, RUN_S = 100.0, 1.0


class Bench:
    """The clock of these tests, and what happened to their task."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.made = 0
        self.threads: list[int] = []
        self.broken = False
        self.setup_may_end, self.run_may_end = threading.Event(), threading.Event()
        self.in_setup, self.in_run = threading.Event(), threading.Event()
        self.setup_may_end.set()
        self.run_may_end.set()


bench = Bench()


def make_model() -> list[int]:
    bench.in_setup.set()
    assert bench.setup_may_end.wait(WAIT_S)
    bench.now_s += SETUP_S
    if bench.broken:
        raise ValueError("no model")
    bench.made += 1
    return [bench.made]


@task("modelled", size=lambda number, scale=1: number * scale, setup=make_model)
def modelled(model: list[int], number: int, scale: int = 1) -> tuple[int, int]:
    bench.threads.append(threading.get_ident())
    bench.in_run.set()
    while not bench.run_may_end.wait(0.001):
        check_wanted()
    bench.now_s += RUN_S
    return number * scale, model[0]


def call(number: int) -> Task:
    return Task(kind_of(modelled), (number, 1), float(number))


@pytest.fixture
def runner(monkeypatch: pytest.MonkeyPatch) -> Iterator[OnboardRunner]:
    bench.__init__()  # type: ignore[misc]
    clock = SimpleNamespace(perf_counter=lambda: bench.now_s, process_time=lambda: 0.0)
    monkeypatch.setattr(onboard, "time", clock)
    monkeypatch.setattr(task_states, "time", clock)
    one = OnboardRunner()
    yield one
    bench.setup_may_end.set()
    bench.run_may_end.set()
    one.close()


def test_callers_do_not_give_the_state() -> None:
    """Binding, input size, items of a batch and the signature are those of a call without it."""
    kind = kind_of(modelled)
    assert kind.bind((3,), {}) == kind.bind((3, 1), {}) == (3, 1)
    assert kind.bind((), {"number": 3, "scale": 2}) == (3, 2)
    assert kind.positional == 2
    assert kind.size_of((3, 2)) == 6
    assert list(kind.signature().parameters) == ["number", "scale"]
    assert [kind.bind(kind.arguments_in(item), {}) for item in [(3, 2), 4]] == [(3, 2), (4, 1)]
    with pytest.raises(TypeError, match="missing a required argument: 'number'"):
        kind.bind((), {})


def test_a_task_with_a_setup_can_be_called_directly() -> None:
    """The decorator returns the function itself, and the hash is that of the function, not of the setup."""
    assert modelled([7], 3, 2) == (6, 7)
    assert "def modelled" in inspect.getsource(kind_of(modelled).function)


@pytest.mark.parametrize("body", ["lambda: 0", "lambda *all: 0"])
def test_a_function_without_a_first_parameter_is_refused(body: str) -> None:
    """The result of the setup needs a parameter."""
    with pytest.raises(ConfigError, match="task bare: setup= needs a function whose first parameter"):
        task("bare", size=abs, setup=make_model)(eval(body))


def test_each_worker_gets_one_state() -> None:
    """`prepare` makes them all, a second one makes none, and a lent state is not lent twice."""
    bench.__init__()  # type: ignore[misc]
    states, kind = TaskStates(2), kind_of(modelled)
    assert not states.ready(kind)
    states.prepare(kind)
    states.prepare(kind)
    assert states.ready(kind)
    with states.lend(kind) as first:
        _, second = Context().run(states.call, kind, (3, 1))
    assert {first[0][0], second} == {1, 2}
    assert states.call(kind, (3, 1))[0] == 3
    assert bench.made == 2


def test_no_time_of_a_task_includes_a_setup(runner: OnboardRunner) -> None:
    """The first task starts the setup and the second one waits behind it: both times are without it."""
    bench.setup_may_end.clear()
    first, second = runner.submit(call(1), 1.0), runner.submit(call(2), 1.0)
    bench.setup_may_end.set()
    one, two = first.result(WAIT_S), second.result(WAIT_S)
    assert (one.queue_s, one.run_s, one.seconds) == (0.0, RUN_S, RUN_S)
    assert (two.queue_s, two.run_s, two.seconds) == (RUN_S, RUN_S, 2 * RUN_S)
    assert bench.now_s == SETUP_S + 2 * RUN_S


def test_a_cancelled_run_keeps_its_state_and_its_thread(runner: OnboardRunner) -> None:
    """The next task waits until the cancelled run ends, and uses the same state in the same thread."""
    bench.run_may_end.clear()
    first = call(1)
    future = runner.submit(first, 1.0)
    assert bench.in_run.wait(WAIT_S)
    runner.cancel(first)
    runner.cancel(first)
    behind = runner.submit(call(2), 1.0)
    stopped = future.result(WAIT_S)  # `check_wanted` raises
    assert isinstance(stopped.failure, Overtaken)
    assert stopped.censored
    assert stopped.started
    bench.run_may_end.set()
    assert behind.result(WAIT_S).value == (2, 1)
    assert len(set(bench.threads)) == 1
    assert bench.made == 1


def test_a_cancelled_run_that_does_not_check_ends_with_its_time(runner: OnboardRunner) -> None:
    """Its time is known, so it is not censored."""

    @task("unchecked", size=float, setup=make_model)
    def unchecked(model: list[int], number: int) -> int:
        bench.in_run.set()
        assert bench.run_may_end.wait(WAIT_S)
        bench.now_s += RUN_S
        return number * model[0]

    bench.run_may_end.clear()
    one = Task(kind_of(unchecked), (1,), 1.0)
    future = runner.submit(one, 1.0)
    assert bench.in_run.wait(WAIT_S)
    runner.cancel(one)
    assert not future.done()
    bench.run_may_end.set()
    ended = future.result(WAIT_S)
    assert (ended.value, ended.seconds, ended.censored) == (1, RUN_S, False)


def test_a_run_cancelled_during_its_setup_does_not_start(runner: OnboardRunner) -> None:
    """The setup goes on, and the next task uses its state."""
    bench.setup_may_end.clear()
    first = call(1)
    future = runner.submit(first, 1.0)
    assert bench.in_setup.wait(WAIT_S)
    runner.cancel(first)
    bench.setup_may_end.set()
    given_up = future.result(WAIT_S)
    assert isinstance(given_up.failure, Overtaken)
    assert (given_up.started, given_up.seconds) == (False, 0.0)
    assert runner.submit(call(2), 1.0).result(WAIT_S).value == (2, 1)


def test_a_site_that_wins_during_a_setup_leaves_no_time_of_it(runner: OnboardRunner) -> None:
    """The overtaken run onboard is recorded without the setup, of which half is over."""

    def answer(one: Task) -> Execution:
        assert bench.in_setup.wait(WAIT_S)
        bench.now_s = SETUP_S / 2
        return Execution(CLOUD, bench.now_s, one.size)

    clock = SystemClock()
    clock.now_s = lambda: bench.now_s  # type: ignore[method-assign]
    bench.setup_may_end.clear()
    late: list[Execution] = []
    race = Race(
        call(1),
        {ONBOARD: runner, CLOUD: ScriptedRunner(CLOUD, answer)},
        clock,
        WAIT_S,
        begun=lambda _: None,
        allowed=lambda _: True,
        late=lambda _, execution: late.append(execution),
    )
    executions = race.run(Plan((ONBOARD, CLOUD)))
    assert [one.seconds for one in executions] == [0.0, SETUP_S / 2]
    bench.setup_may_end.set()
    assert runner.submit(call(2), 1.0).result(WAIT_S).value == (2, 1)
    assert [(one.started, one.censored) for one in late] == [(False, True)]


def test_a_setup_that_raises_fails_its_calls_and_is_tried_again(runner: OnboardRunner) -> None:
    """TaskFailed names the task and keeps the cause. After SETUP_AGAIN_S, a call tries the setup again."""
    bench.broken = True
    for _ in range(3):
        failed = runner.submit(call(1), 1.0).result(WAIT_S)
        assert isinstance(failed.failure, TaskFailed)
        assert str(failed.failure) == "setup of task modelled: ValueError: no model"
        assert isinstance(failed.failure.__cause__, ValueError)
        assert "make_model" in failed.failure.traceback
        assert (failed.seconds, failed.started) == (0.0, False)
        assert bench.now_s == SETUP_S
    bench.now_s += SETUP_AGAIN_S
    assert isinstance(runner.submit(call(1), 1.0).result(WAIT_S).failure, TaskFailed)
    assert bench.now_s == 2 * SETUP_S + SETUP_AGAIN_S
    bench.now_s += SETUP_AGAIN_S
    bench.broken = False
    assert runner.submit(call(2), 1.0).result(WAIT_S).value == (2, 1)


def test_a_setup_that_raises_for_one_worker_leaves_the_state_of_another() -> None:
    """Calls wait for the state that was made, and do not fail."""
    bench.__init__()  # type: ignore[misc]
    states, kind = TaskStates(2), kind_of(modelled)
    with states.lend(kind) as first:
        bench.broken = True
        with pytest.raises(TaskFailed, match="no model"):
            Context().run(states.call, kind, (3, 1))
        ended: list[object] = []
        waits = threading.Thread(target=lambda: ended.append(states.call(kind, (3, 1))))
        waits.start()
        waits.join(0.05)
        assert not ended
    waits.join(WAIT_S)
    assert ended == [(3, first[0][0])]


def test_waiting_for_sites_runs_the_setup(runner: OnboardRunner) -> None:
    """The first task then finds its state; a setup that takes too long, or raises, is the reason given."""
    sites, kind = {"onboard": runner}, kind_of(modelled)
    bench.setup_may_end.clear()
    slow = wait_for_sites(sites, kind, 0.0, Absent())
    assert slow == {"onboard": "the setup of task modelled is not over"}
    bench.broken = True
    bench.setup_may_end.set()
    assert wait_for_sites(sites, kind, WAIT_S, Absent()) == {
        "onboard": "setup of task modelled: ValueError: no model"
    }
    bench.broken = False
    found = wait_for_sites(sites, kind, WAIT_S, Absent())
    assert (found, str(found)) == ({}, "all sites can take this task")
    assert runner.submit(call(2), 1.0).result(WAIT_S).value == (2, 1)


@pytest.mark.parametrize("setup_ends", [True, False])
def test_a_reason_that_waiting_cannot_change_is_not_waited_for(
    runner: OnboardRunner, setup_ends: bool
) -> None:
    """Other reasons, and the setup onboard, still are."""
    other = ScriptedRunner(CLOUD, lambda one: Execution(CLOUD, 1.0, one.size), Lasting("other source"))
    sites, kind = {CLOUD: other, ONBOARD: runner}, kind_of(modelled)
    if not setup_ends:
        bench.setup_may_end.clear()
    began_s = time.monotonic()
    absent = wait_for_sites(sites, kind, WAIT_S if setup_ends else 0.1, Absent())
    waited_s = time.monotonic() - began_s
    assert absent[CLOUD] == "other source"
    assert waited_s < WAIT_S / 2 if setup_ends else waited_s >= 0.1
    other.absent = "not connected"
    began_s = time.monotonic()
    assert wait_for_sites(sites, kind, 0.1, Absent())[CLOUD] == "not connected"
    assert time.monotonic() - began_s >= 0.1


def test_absent_sites_read_well() -> None:
    """Empty it is false and says so; otherwise each site has its reason."""
    assert not Absent()
    assert repr(Absent()) == "<Absent: all sites can take this task>"
    both = Absent(cloud="not connected", edge="no task")
    assert f"{both}" == "cloud: not connected; edge: no task"
