"""A run of tasks: closed and open arrivals, its answers file, and failures."""

import itertools
import signal
import threading
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from offboard.common.errors import TaskFailed
from offboard.common.wording import duration
from offboard.loadgen.robot import answers as answers_file
from offboard.loadgen.robot import run as run_module
from offboard.loadgen.robot.answers import Answers
from offboard.loadgen.robot.calls import Calls
from offboard.loadgen.robot.config import CallConfig
from offboard.loadgen.robot.run import MADE_MAX, OwnRecord, Run, made_ahead
from offboard.robot_client.records.record import Record
from offboard.robot_client.sites.onboard import OnboardRunner
from offboard.robot_client.sites.runner import CLOUD, Execution
from tests.fakes import ScriptedRunner
from tests.scripted import offloader, script, scripted

WAIT_S = 5.0  # for another thread; a test fails when it is over


@pytest.fixture(autouse=True)
def fresh_script() -> None:
    script.reset()


def quiet(_: str) -> None:
    """Says nothing."""


def answered(folder: Path, *, workers: int = 16, **settings: Any) -> tuple[list[dict[str, Any]], list[str]]:
    """The answers and the summary of onboard calls of `scripted` with the numbers 0, 1, 2, ..."""
    config = CallConfig(
        task="m:scripted", sizes=("constant:0",), answers=folder / "answers.jsonl", **settings
    )
    answers, own, said = Answers(folder / "answers.jsonl"), OwnRecord(), list[str]()
    with offloader(OnboardRunner(workers), observers=[own]) as offload:
        work = Calls(scripted, zip(itertools.count()))
        try:
            Run(config, work, offload, own=own, say=said.append, answers=answers).run()
        finally:
            answers.close()
    return list(answers_file.read(folder / "answers.jsonl")), said


def test_closed_arrivals_wait_for_the_answer(tmp_path: Path) -> None:
    """One task runs at a time, in order; each is due when it starts, after the end of the previous one."""
    lines, said = answered(tmp_path, tasks=20)
    assert [line["i"] for line in lines] == script.asked == list(range(20))
    assert script.most == 1
    assert all(line["due_s"] == line["began_s"] <= line["ended_s"] for line in lines)
    assert all(a["ended_s"] <= b["began_s"] for a, b in pairwise(lines))
    assert said[0] == "20 tasks answered"
    assert not any("due" in line for line in said)


def test_tasks_that_depend_on_no_answer_are_made_before_the_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """Up to MADE_FIRST_MAX of them; further ones are made one by one, after the previous answer."""
    monkeypatch.setattr(run_module, "MADE_FIRST_MAX", 3)
    made: list[int] = []

    def wanted() -> Iterator[tuple[int]]:
        for number in itertools.count():
            made.append(number)
            yield (number,)

    seen: list[int] = []
    script.act = lambda _: seen.append(len(made))
    config, own = CallConfig(task="m:f", sizes=("constant:0",), tasks=6), OwnRecord()
    with offloader(OnboardRunner(), observers=[own]) as offload:
        Run(config, Calls(scripted, wanted()), offload, own=own, say=quiet).run()
    assert seen == [3, 3, 3, 4, 5, 6]


def test_open_arrivals_keep_their_due_instants(tmp_path: Path) -> None:
    """Tasks behind a slow one start late; the instants when they were due do not move."""
    released = threading.Event()
    script.act = lambda number: released.wait(0.2) if number == 0 else None
    lines, said = answered(tmp_path, tasks=15, arrivals="constant", rate=200.0, in_flight=1)
    assert [line["due_s"] for line in lines] == [n / 200.0 for n in range(15)]
    assert all(line["began_s"] >= line["due_s"] for line in lines)
    assert all(line["began_s"] >= lines[0]["ended_s"] for line in lines[1:])
    late = sorted(line["began_s"] - line["due_s"] for line in lines)
    over = sum(seconds > 0.01 for seconds in late)
    counted = f"started over 10 ms after they were due: {over} of 15 tasks"
    assert said[-1] == f"{counted}; P95 of the delay: {duration(late[14])}"
    assert over >= 14


def test_open_arrivals_do_not_wait_for_answers(tmp_path: Path) -> None:
    """Task 0 ends only after all other tasks have run, so they do not wait for it."""
    others = threading.Semaphore(0)

    def act(number: int) -> bool:
        if number == 0:
            return all(others.acquire(timeout=WAIT_S) for _ in range(7))
        others.release()
        return True

    script.act = act
    lines, _ = answered(tmp_path, tasks=8, arrivals="poisson", rate=1000.0, in_flight=2)
    assert {line["i"] for line in lines} == set(range(8))
    assert [line["answer"] for line in lines] == [answers_file.of_value(True, ())] * 8
    assert {line["id"].partition("-")[2] for line in lines} == {str(n) for n in range(8)}
    assert len({line["id"].partition("-")[0] for line in lines}) == 1


def test_each_answer_has_the_id_of_its_record(tmp_path: Path) -> None:
    """With eight tasks at the same time, the record with the id of an answer has its size."""
    records: list[Record] = []
    barrier = threading.Barrier(8)
    script.act = lambda _: barrier.wait(WAIT_S) and None
    config = CallConfig(
        task="m:f", sizes=("constant:0",), tasks=40, arrivals="bursts", rate=4000.0, burst=8, in_flight=8
    )
    answers, own = Answers(tmp_path / "answers.jsonl"), OwnRecord()
    with offloader(OnboardRunner(8), observers=[own, records.append]) as offload:
        work = Calls(scripted, zip(itertools.count()))
        Run(config, work, offload, own=own, say=quiet, answers=answers).run()
    answers.close()
    sizes = {record.id: record.size for record in records}
    lines = list(answers_file.read(tmp_path / "answers.jsonl"))
    assert len(lines) == 40
    assert all(sizes[line["id"]] == line["i"] for line in lines)


def test_the_tasks_in_flight_are_bounded(tmp_path: Path) -> None:
    """Of twelve tasks that are due at once, three run at the same time, and never a fourth."""
    barrier = threading.Barrier(3)
    script.act = lambda _: barrier.wait(WAIT_S) and None
    settings = {"arrivals": "bursts", "rate": 1000.0, "burst": 12}
    lines, _ = answered(tmp_path, tasks=12, in_flight=3, **settings)
    assert {line["due_s"] for line in lines} == {0.0}
    assert [line["error"] for line in lines] == [None] * 12
    assert script.most == 3


@pytest.mark.parametrize("settings", [{}, {"arrivals": "poisson", "rate": 500.0}], ids=["closed", "open"])
def test_a_failing_task_does_not_end_the_run(tmp_path: Path, settings: dict[str, Any]) -> None:
    """The line of a failed task has an error, the id of its record and no answer."""

    def act(number: int) -> Any:
        if number == 3:
            raise ValueError("three")
        return object() if number == 5 else number

    script.act = act
    lines, said = answered(tmp_path, tasks=10, **settings)
    lines.sort(key=lambda line: int(line["i"]))
    assert [line["i"] for line in lines] == list(range(10))
    assert lines[3]["error"] == "TaskFailed: task scripted: ValueError: three"
    assert lines[5]["error"].startswith("BadValue: a value of type builtins.object")
    assert [line["answer"] is None for line in lines] == [n in (3, 5) for n in range(10)]
    assert all(line["id"] for line in lines)
    assert said[0] == "8 tasks answered; 2 failed"


@pytest.mark.parametrize("settings", [{}, {"arrivals": "poisson", "rate": 500.0}], ids=["closed", "open"])
def test_without_an_answers_file_a_failure_ends_the_run(settings: dict[str, Any]) -> None:
    """The failure of the task is raised, and only a few later tasks are asked for."""

    def act(number: int) -> None:
        if number == 3:
            raise ValueError("three")

    script.act = act
    config = CallConfig(task="m:f", sizes=("constant:0",), tasks=10_000, in_flight=2, **settings)
    own = OwnRecord()
    with offloader(OnboardRunner(), observers=[own]) as offload:
        work = Calls(scripted, zip(itertools.count()))
        with pytest.raises(TaskFailed, match="three"):
            Run(config, work, offload, own=own, say=quiet).run()
    assert len(script.asked) < 100


@pytest.mark.parametrize("settings", [{}, {"arrivals": "constant", "rate": 500.0}], ids=["closed", "open"])
def test_answered_tasks_are_not_asked_again(tmp_path: Path, settings: dict[str, Any]) -> None:
    """A run whose file has answers asks for each missing task once, with its own number."""
    path = tmp_path / "answers.jsonl"
    answered(tmp_path, tasks=12, **settings)
    kept = [line for line in path.read_text().splitlines() if answers_number(line) not in (2, 5, 6)]
    path.write_text("".join(f"{line}\n" for line in kept[:7]))
    there = {answers_number(line) for line in kept[:7]}
    script.asked.clear()
    lines, said = answered(tmp_path, tasks=15, **settings)
    missing = [n for n in range(15) if n not in there]
    assert sorted(script.asked) == missing
    assert sorted(line["i"] for line in lines) == list(range(15))
    values = {line["i"]: line["answer"] for line in lines}
    assert values == {n: answers_file.of_value(n, ()) for n in range(15)}
    assert said[:2] == ["7 of 15 tasks had their answer before", "8 tasks answered"]
    if settings:  # the first missing task is due at once; the gaps between the others stay
        dues = {line["i"]: line["due_s"] for line in lines[7:]}
        assert dues == pytest.approx({n: (n - missing[0]) / 500.0 for n in missing})


def answers_number(line: str) -> int:
    return int(line.partition('"i":')[2].partition(",")[0])


def test_an_interrupted_run_writes_no_answer_for_given_up_tasks(tmp_path: Path) -> None:
    """After Ctrl-C with tasks in flight, the file has only the tasks that were answered before."""
    closed, path = threading.Event(), tmp_path / "answers.jsonl"

    class Onboard(OnboardRunner):
        def close(self) -> None:
            closed.set()
            super().close()

    ran = itertools.count()  # four threads ask, in any order

    def act(_number: int) -> None:
        place = next(ran)
        if place == 2:
            until = time.monotonic() + WAIT_S
            while len(path.read_text().splitlines()) < 2 and time.monotonic() < until:
                time.sleep(0.001)
            signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
        if place >= 2:
            assert closed.wait(WAIT_S)

    script.act = act
    config = CallConfig(
        task="m:f", sizes=("constant:0",), tasks=100, in_flight=4, arrivals="constant", rate=1000.0
    )
    answers, own = Answers(path), OwnRecord()
    with offloader(Onboard(), observers=[own]) as offload:
        work = Calls(scripted, zip(itertools.count()))
        run = Run(config, work, offload, own=own, say=quiet, answers=answers)
        with pytest.raises(KeyboardInterrupt):
            run.run()
    answers.close()
    assert [line["error"] for line in answers_file.read(path)] == [None, None]


def test_an_interrupted_run_says_what_was_done() -> None:
    """After Ctrl-C, the summary of the tasks that were answered before is said."""
    closed, said, own = threading.Event(), list[str](), OwnRecord()

    def act(number: int) -> None:
        if number == 3:
            signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
            assert closed.wait(WAIT_S)

    script.act = act
    config = CallConfig(task="m:f", sizes=("constant:0",), tasks=10)
    with offloader(OnboardRunner(), observers=[own]) as offload:
        run = Run(config, Calls(scripted, zip(itertools.count())), offload, own=own, say=said.append)
        with pytest.raises(KeyboardInterrupt):
            run.run()
        closed.set()
    assert said[0] == "3 tasks answered"
    assert len(said) == 2


def test_tasks_are_made_ahead_in_order_and_bounded() -> None:
    """MADE_MAX tasks are made ahead; an error in making a task is raised where the task is asked for."""
    made: list[int] = []

    def tasks() -> Iterator[int]:
        for number in range(2 * MADE_MAX):
            made.append(number)
            yield number
        raise ValueError("no more")

    found = made_ahead(tasks())
    assert next(found) == 0
    assert MADE_MAX <= len(made) <= MADE_MAX + 1
    with pytest.raises(ValueError, match="no more"):
        made += list(found)
    assert list(made_ahead(iter(range(100)))) == list(range(100))


def test_warming_changes_no_task_of_the_run() -> None:
    """The warm-up runs the first task on all sites by another offloader; the run asks for it again."""
    cloud = ScriptedRunner(CLOUD, lambda one: Execution(CLOUD, 0.1, one.args[0]))
    config = CallConfig(task="m:f", sizes=("constant:0",), tasks=3)
    own = OwnRecord()
    with offloader(cloud, OnboardRunner()) as unseen, offloader(OnboardRunner(), observers=[own]) as offload:
        work = Calls(scripted, zip(itertools.count()))
        run = Run(config, work, offload, own=own, say=quiet)
        run.warm(unseen)
        assert [one.args for one in cloud.tasks] == [(0,)]
        assert script.asked == [0]
        run.run()
    assert script.asked == [0, 0, 1, 2]
    assert len(cloud.tasks) == 1
