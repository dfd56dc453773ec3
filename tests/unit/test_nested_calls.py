"""Calls that the code of a task makes: they end, wherever and however they are made."""

import asyncio
import threading
from collections.abc import Callable, Iterator

import pytest

from offboard import Offloader, Settings
from offboard.common import tasks
from offboard.common.errors import Overtaken, Unwanted
from offboard.common.task_call import check_wanted
from offboard.common.task_states import TaskStates
from offboard.common.tasks import Task, kind_of, task
from offboard.robot_client.sites.onboard import OnboardRunner
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, Execution
from tests.fakes import ScriptedRunner

WAIT_S = 5.0


class Bench:
    """The offloader that the tasks call, and in which threads they ran."""

    def __init__(self) -> None:
        self.threads: list[str] = []
        self.in_use = 0
        self.begun, self.stopped = threading.Event(), threading.Event()
        self.offload: Offloader
        self.way: Callable[[Callable[..., int], int], int]


bench = Bench()


@task("count_down", size=float)
def count_down(number: int) -> int:
    bench.threads.append(threading.current_thread().name)
    return 0 if number == 0 else 1 + bench.way(count_down, number - 1)


@task("count_down_with_model", size=float, setup=list)
def count_down_with_model(model: list[int], number: int) -> int:
    bench.threads.append(threading.current_thread().name)
    model.append(number)
    assert model == list(range(model[0], number - 1, -1))  # each nested call uses the state of its caller
    result = 0 if number == 0 else 1 + bench.way(count_down_with_model, number - 1)
    assert model.pop() == number
    return result


async def together(function: Callable[..., int], number: int) -> int:
    answers = await asyncio.gather(*(bench.offload.run(function, number) for _ in range(3)))
    assert len(set(answers)) == 1
    return answers[0]


WAYS: dict[str, Callable[[Callable[..., int], int], int]] = {
    "call": lambda function, number: bench.offload(function, number),
    "pinned": lambda function, number: bench.offload(function, number, where=ONBOARD),
    "map": lambda function, number: bench.offload.map(function, [number] * 3)[2],
    "asyncio": lambda function, number: asyncio.run(together(function, number)),
    "submitted": lambda function, number: bench.offload.submit(function, number).result(),
    "deadline": lambda function, number: bench.offload(function, number, deadline_s=WAIT_S),
}


@pytest.fixture
def offload() -> Iterator[Offloader]:
    bench.__init__()  # type: ignore[misc]
    with Offloader.connect() as bench.offload:
        yield bench.offload


@pytest.mark.parametrize("function", [count_down, count_down_with_model])
@pytest.mark.parametrize("way", WAYS)
def test_a_call_of_a_task_onboard_ends(offload: Offloader, way: str, function: Callable[..., int]) -> None:
    """A task that calls tasks gets their answers, however it calls them, and later tasks run too."""
    bench.way = WAYS[way]
    assert offload(function, 3) == 3
    assert offload(function, 2) == 2
    assert offload.map(function, [1, 2]) == [1, 2]


@pytest.mark.parametrize("way", ["call", "pinned"])
def test_a_call_of_a_task_runs_in_its_thread(offload: Offloader, way: str) -> None:
    """All of it runs in the thread of the only worker."""
    bench.way = WAYS[way]
    assert offload(count_down, 2) == 2
    assert set(bench.threads) == {ONBOARD}


@pytest.mark.parametrize("policy", ["paper", "default", "cloud", ONBOARD])
@pytest.mark.parametrize("function", [count_down, count_down_with_model])
def test_a_call_of_a_task_ends_with_a_cloud_too(policy: str, function: Callable[..., int]) -> None:
    """Whichever site the nested calls are sent to, the answers are right."""
    bench.__init__()  # type: ignore[misc]
    bench.way = WAYS["call"]
    settings = Settings(window=5)
    cloud = ScriptedRunner(CLOUD, lambda one: Execution(CLOUD, 0.01, one.args[0]))
    with Offloader(
        [cloud, OnboardRunner()],
        policy=settings.make_policy(policy),
        memories=settings.make_memories(policy),
    ) as bench.offload:
        for number in range(20):
            assert bench.offload(function, number % 4) == number % 4


def test_more_calls_in_asyncio_than_threads_that_make_calls() -> None:
    """If all threads for asyncio wait for the worker, its task can still call tasks in asyncio."""
    bench.__init__()  # type: ignore[misc]
    bench.way = WAYS["asyncio"]

    async def many() -> list[int]:
        return await asyncio.gather(*(bench.offload.run(count_down, 1) for _ in range(100)))

    with Offloader.connect() as bench.offload:
        assert asyncio.run(many()) == [1] * 100


def test_a_setup_may_call_a_task() -> None:
    """It does so in `wait_for_sites`, while the worker waits for the same setup."""
    bench.__init__()  # type: ignore[misc]
    bench.way = WAYS["call"]
    going = threading.Event()

    def make_model() -> int:
        bench.begun.set()
        assert going.wait(WAIT_S)
        return bench.offload(count_down, 1)

    @task("with_calling_setup", size=float, setup=make_model)
    def with_calling_setup(model: int, number: int) -> int:
        return model + number

    with Offloader.connect() as bench.offload:
        prepare = threading.Thread(target=bench.offload.wait_for_sites, args=(with_calling_setup, WAIT_S))
        prepare.start()
        assert bench.begun.wait(WAIT_S)
        call = threading.Thread(target=bench.offload, args=(with_calling_setup, 1))
        call.start()
        going.set()
        call.join(WAIT_S)
        prepare.join(WAIT_S)
        assert bench.offload(with_calling_setup, 2) == 3
    tasks._kinds.pop("with_calling_setup")  # servers of later tests run the setups of all kinds


@task("call_then_look", size=float)
def call_then_look(number: int) -> None:
    bench.way(count_down, number)
    bench.begun.set()
    try:
        while True:
            check_wanted()
            threading.Event().wait(0.001)
    except Unwanted:
        bench.stopped.set()
        raise


@pytest.mark.usefixtures("offload")
def test_a_task_still_learns_that_it_is_unwanted_after_a_call() -> None:
    """`check_wanted` speaks of the task itself again once its call has ended."""
    bench.way = WAYS["call"]
    runner = OnboardRunner()
    one = Task(kind_of(call_then_look), (1,), 1.0)
    future = runner.submit(one, 1.0)
    assert bench.begun.wait(WAIT_S)
    runner.cancel(one)
    assert isinstance(future.result(WAIT_S).failure, Overtaken)
    assert bench.stopped.wait(WAIT_S)
    runner.close()


def test_calls_of_one_task_use_its_state_one_after_the_other() -> None:
    """Two nested calls at a time, from copies of the context of their caller, never share the state."""
    from contextvars import copy_context

    states, kind, most = TaskStates(1), kind_of(count_down_with_model), list[int]()

    def use() -> None:
        with states.lend(kind):
            bench.in_use += 1
            most.append(bench.in_use)
            threading.Event().wait(0.02)
            bench.in_use -= 1

    bench.__init__()  # type: ignore[misc]
    with states.lend(kind):
        threads = [threading.Thread(target=copy_context().run, args=(use,)) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(WAIT_S)
    assert most == [1] * 4
