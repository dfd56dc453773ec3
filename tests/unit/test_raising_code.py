"""Code of a user may raise anything: the caller gets one error that names the task, and no thread dies."""

import asyncio
import builtins
import logging
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from offboard import Offloader, Settings
from offboard.common.errors import BadValue, TaskError, TaskFailed, describe
from offboard.common.tasks import task
from offboard.common.wire import messages as wire
from offboard.robot_client.cloud.wire_request import WireRequest
from offboard.robot_client.sites.onboard import OnboardRunner
from offboard.robot_client.sites.outgoing import BlobUploads, Outgoing
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, Execution
from tests.fakes import ScriptedRunner


class Own(BaseException):
    """An error of a user."""


class Unreadable(Exception):
    """An error whose text ends the process."""

    def __str__(self) -> str:
        raise SystemExit("no text")


class Nameless(type):
    """A class whose name cannot be read."""

    @property
    def __name__(cls) -> str:  # type: ignore[override]
        raise SystemExit("no name")


class Hidden(Exception, metaclass=Nameless):
    """An error that does not say what it is."""


RAISED: list[BaseException] = [
    ValueError("text"),
    SystemExit(3),
    GeneratorExit(),
    StopIteration(1),
    StopAsyncIteration(),
    asyncio.CancelledError(),
    MemoryError(),
    RecursionError(),
    Own("text"),
    Unreadable(),
]
if sys.version_info >= (3, 11):
    RAISED += [
        builtins.ExceptionGroup("group", [Unreadable()]),
        builtins.BaseExceptionGroup("group", [Own(), SystemExit()]),
    ]
CALLS = ("call", "map", "asyncio")
raised: list[BaseException] = []


def fail(*_: Any) -> Any:
    if raised:
        raise raised[0]
    return 1.0


@task("fails", size=float)
def fails(number: int) -> int:
    fail()
    return number


@task("fails_in_size", size=fail)
def fails_in_size(number: int) -> int:
    return number


@task("fails_in_setup", size=float, setup=fail)
def fails_in_setup(_: Any, number: int) -> int:
    return number


@task("fails_in_work", size=float, work=fail)
def fails_in_work(number: int) -> int:
    return number


@task("sound", size=float)
def sound(number: int) -> int:
    return number


def answer(offload: Offloader, way: str, function: Callable[..., int]) -> int:
    if way == "map":
        return offload.map(function, [7])[0]
    return asyncio.run(offload.run(function, 7)) if way == "asyncio" else offload(function, 7)


@pytest.fixture
def fresh() -> Iterator[None]:
    raised.clear()
    yield
    raised.clear()


@pytest.mark.usefixtures("fresh")
@pytest.mark.parametrize("way", CALLS)
@pytest.mark.parametrize("error", RAISED, ids=lambda error: type(error).__name__)
def test_what_a_function_of_a_task_raises_is_one_error_with_its_name(error: BaseException, way: str) -> None:
    """This holds for the task, its size and its setup. The offloader works on."""
    with Offloader.connect() as offload:
        for function, expected in (
            (fails, TaskFailed),
            (fails_in_size, BadValue),
            (fails_in_setup, TaskFailed),
        ):
            assert answer(offload, way, sound) == 7
            raised.append(error)
            with pytest.raises(
                TaskError, match=rf"task {function.__name__}: .*{type(error).__name__}"
            ) as caught:
                answer(offload, way, function)
            raised.clear()
            assert isinstance(caught.value, expected)
            assert caught.value.__cause__ is error
        workers = [thread for thread in threading.enumerate() if thread.name == ONBOARD]
        assert len(workers) == 1
        assert answer(offload, way, sound) == 7
        assert workers == [thread for thread in threading.enumerate() if thread.name == ONBOARD]


@pytest.mark.usefixtures("fresh")
def test_an_error_whose_class_has_no_name_is_one_error_too() -> None:
    """It has a name all the same."""
    with Offloader.connect() as offload:
        raised.append(Hidden())
        with pytest.raises(TaskFailed, match=r"^task fails: Hidden: \(it has no readable text\)$"):
            offload(fails, 7)
        raised.clear()
        assert offload(sound, 7) == 7


@pytest.mark.usefixtures("fresh")
@pytest.mark.parametrize("way", CALLS)
@pytest.mark.parametrize("error", RAISED, ids=lambda error: type(error).__name__)
def test_what_an_observer_or_work_raises_costs_no_answer(
    error: BaseException, way: str, caplog: pytest.LogCaptureFixture
) -> None:
    """The answer is returned, and the log names the task."""
    caplog.set_level(logging.ERROR)
    with Offloader.connect(observers=[fail]) as offload:
        raised.append(error)
        assert answer(offload, way, fails_in_work) == 7
        assert "failed on task 0 (fails_in_work)" in caplog.text
        assert "cannot read the work of task fails_in_work" in caplog.text
        raised.clear()
        assert answer(offload, way, sound) == 7


@pytest.mark.usefixtures("fresh")
def test_a_late_run_whose_work_cannot_be_read_ends_no_thread() -> None:
    """The worker whose answer came second still runs the next task."""
    settings = Settings(window=5)
    gate, begun = threading.Event(), threading.Event()

    @task("late_work", size=float, work=fail)
    def late_work(number: int) -> int:
        begun.set()
        gate.wait(5.0)
        return number

    def script(one: Any) -> Execution:
        return Execution(CLOUD, 0.01, one.args[0])

    onboard = OnboardRunner()
    with Offloader(
        [ScriptedRunner(CLOUD, script), onboard],
        policy=settings.make_policy("probe:cloud"),
        memories=settings.make_memories("probe:cloud"),
    ) as offload:
        for _ in range(30):
            assert offload(late_work, 1) == 1
        assert begun.wait(5.0), "no probe has begun onboard"
        workers = [thread for thread in threading.enumerate() if thread.name == ONBOARD]
        raised.append(SystemExit())
        gate.set()
        assert offload(late_work, 2, where="onboard") == 2
        raised.clear()
        assert offload(sound, 2, where="onboard") == 2
        assert all(thread.is_alive() for thread in workers)


@pytest.mark.usefixtures("fresh")
def test_ctrl_c_is_passed_on() -> None:
    """KeyboardInterrupt in the main thread is no failure of a size function or an observer.

    In the thread of a worker it is the failure of the task, because Ctrl-C comes to the main thread only.
    """
    with Offloader.connect() as offload:
        raised.append(KeyboardInterrupt())
        with pytest.raises(TaskFailed, match="task fails: KeyboardInterrupt"):
            offload(fails, 1)
    with Offloader.connect(observers=[fail]) as offload:
        with pytest.raises(KeyboardInterrupt):
            offload(sound, 1)
        with pytest.raises(KeyboardInterrupt):
            offload(fails_in_size, 1)
        raised.clear()
        assert offload(sound, 1) == 1


def test_an_error_of_the_cloud_names_the_task_once() -> None:
    """The server says what was raised; a setup or a crash may name the task already."""

    from offboard.common.tasks import Task, kind_of

    one = Task(kind_of(sound), (1,), 1.0)
    outgoing = Outgoing(one, BlobUploads().inline_rule("sound", 1000), compresses=False)
    pending = WireRequest(
        site=CLOUD,
        task=one,
        published_s=0.0,
        deadline_s=1.0,
        body=wire.encode([1], ()),
        outgoing=outgoing,
    )
    for text in ("ValueError: no", "setup of task sound: ValueError: no"):
        reply = wire.Reply(one.id, "failed", queue_s=0.0, run_s=0.0, error=text)
        failure = str(pending.answered(reply, 0.5, 10).failure)
        assert failure in ("task sound: ValueError: no", "setup of task sound: ValueError: no")


def test_a_text_that_cannot_be_read_is_described() -> None:
    """The type is named, and the end of the process in `__str__` is not obeyed."""
    assert describe(Unreadable()) == "Unreadable: (it has no readable text)"
    assert describe(Hidden()) == "Hidden: (it has no readable text)"
