"""Driving work through an offloader: closed and open arrivals, answers, references, tasks measured alone."""

import itertools
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from offboard.common.errors import CloudTimeout, TaskFailed
from offboard.common.planning.maps import GridMap
from offboard.common.planning.planner import plan_path, warm
from offboard.common.tasks import Task, kind_of, task
from offboard.robot_client.learning.memories import Memories
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.policies import BOTH
from offboard.robot_client.policies.paper import Paper
from offboard.robot_client.predictors import LEAST_SQUARES, make
from offboard.robot_client.records.trace import Record
from offboard.robot_client.simulated import answers as answers_file
from offboard.robot_client.simulated import drive as drive_module
from offboard.robot_client.simulated import references as references_file
from offboard.robot_client.simulated.answers import Answers
from offboard.robot_client.simulated.config import RobotConfig
from offboard.robot_client.simulated.drive import MADE_MAX, WAYS, Drive, OwnRecord, made_ahead
from offboard.robot_client.simulated.references import References, orders
from offboard.robot_client.simulated.robot import SimulatedRobot
from offboard.robot_client.simulated.task_source import Calls, Plans
from offboard.robot_client.sites.onboard import OnboardRunner
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, Execution, Runner
from tests.fakes import ScriptedRunner

PLANS = 4
WAIT_S = 5.0  # for another thread; the tests fail where it is over
warm()  # compiles before the clock of any test runs


@pytest.mark.parametrize("seed", range(5))
def test_no_way_is_favoured(seed: int) -> None:
    """After every three plans each way was first, second and third equally often."""
    found = orders(30, seed, WAYS)
    assert all(sorted(order) == sorted(WAYS) for order in found)
    for place in range(3):
        for end in range(3, 31, 3):
            assert set(Counter(order[place] for order in found[:end]).values()) == {end // 3}


def test_the_seed_decides_the_order() -> None:
    """The same seed gives the same orders, whatever their number; seeds differ; each way may follow each."""
    assert orders(9, 4, WAYS)[:5] == orders(5, 4, WAYS)
    assert len({tuple(orders(9, seed, WAYS)) for seed in range(20)}) > 1
    follows = {pair for seed in range(20) for order in orders(9, seed, WAYS) for pair in pairwise(order)}
    assert follows == {(a, b) for a in WAYS for b in WAYS if a != b}


def offloader(*runners: Runner, observers: Sequence[Callable[[Record], None]] = ()) -> Offloader:
    return Offloader(
        runners, policy=Paper(), memories=Memories(lambda: make(LEAST_SQUARES, 5)), observers=list(observers)
    )


def measured(fails: set[int]) -> tuple[list[Record], list[str]]:
    """What is recorded and said of four plans, where the cloud fails at the tasks of these numbers."""
    cells = np.full((40, 40), 100, np.int8)
    cells[1:-1, 1:-1] = 0
    asked = 0

    def answer(task: Task) -> Execution:
        nonlocal asked
        asked += 1
        if asked in fails:
            return Execution(CLOUD, 2.0, failure=CloudTimeout("late"), censored=True)
        return Execution(CLOUD, 0.1, plan_path(*task.args))

    records: list[Record] = []
    said: list[str] = []
    config = RobotConfig(
        map=Path("open.map"),
        cloud="tcp://cloud:5555",
        trace=Path("trace.jsonl"),
        tasks=PLANS,
        alone=PLANS,
        seed=3,
    )
    work = Plans(SimulatedRobot(GridMap(cells, 0.1), seed=3), None, jump=False)
    with offloader(ScriptedRunner(CLOUD, answer), OnboardRunner(), observers=[records.append]) as offload:
        Drive(config, work, offload, OwnRecord(), said.append).run_alone(offload)
    return records, said


def test_each_plan_runs_in_three_ways() -> None:
    """Three records a plan, of one size, on each site alone and on both, in the order of the seed."""
    records, said = measured(fails=set())
    sites = {ONBOARD: {ONBOARD}, CLOUD: {CLOUD}, BOTH: {ONBOARD, CLOUD}}
    wanted = [sites[way] for order in orders(PLANS, 3, WAYS) for way in order]
    assert [{one.site for one in record.executions} for record in records] == wanted
    sizes = [record.size for record in records]
    assert sizes[::3] == sizes[1::3] == sizes[2::3]
    assert len(set(sizes)) == PLANS
    assert {record.decision.policy for record in records} == {"pinned"}
    assert said == ["run on each site alone and on both at once: 4 of 4 plans"]


def test_a_cloud_that_fails_is_said() -> None:
    """Plans that lack a way are counted out, wherever the cloud failed; the rest goes on."""
    records, said = measured(fails={1, 3, 4})  # the cloud takes two tasks of each plan
    assert len(records) == 3 * PLANS
    missing = "; the cloud did not answer for the others"
    assert said == [f"run on each site alone and on both at once: 2 of 4 plans{missing}"]


class Script:
    """What the task `scripted` does with each number, and how many of its calls run at once at most."""

    def __init__(self) -> None:
        self.act: Callable[[int], Any] = lambda number: number
        self.most = 0
        self.asked: list[int] = []
        self._now = 0
        self._lock = threading.Lock()

    def run(self, number: int) -> Any:
        with self._lock:
            self._now += 1
            self.most = max(self.most, self._now)
            self.asked.append(number)
        try:
            return self.act(number)
        finally:
            with self._lock:
                self._now -= 1


script = Script()


@task("scripted", size=lambda number: number)
def scripted(number: int) -> Any:
    return script.run(number)


@pytest.fixture(autouse=True)
def fresh_script() -> None:
    script.__init__()  # type: ignore[misc]


def drive(folder: Path, *, workers: int = 16, **settings: Any) -> tuple[list[dict[str, Any]], list[str]]:
    """The answers and the summary of calls of `scripted` with their own numbers, 0, 1, 2, ..., onboard."""
    config = RobotConfig(
        task="m:scripted", sizes=("constant:0",), answers=folder / "answers.jsonl", **settings
    )
    answers, own, said = Answers(folder / "answers.jsonl"), OwnRecord(), list[str]()
    with offloader(OnboardRunner(workers), observers=[own]) as offload:
        work = Calls(scripted, map(float, itertools.count()))
        try:
            Drive(config, work, offload, own, said.append, answers=answers).run()
        finally:
            answers.close()
    return list(answers_file.read(folder / "answers.jsonl")), said


def test_closed_arrivals_wait_for_the_answer(tmp_path: Path) -> None:
    """One task at a time, in order, each due when it is asked, after the last one's end."""
    lines, said = drive(tmp_path, tasks=20)
    assert [line["i"] for line in lines] == script.asked == list(range(20))
    assert script.most == 1
    assert all(line["due_s"] == line["began_s"] <= line["ended_s"] for line in lines)
    assert all(a["ended_s"] <= b["began_s"] for a, b in pairwise(lines))
    assert said[0] == "20 tasks answered"
    assert not any("due" in line for line in said)


def test_tasks_that_depend_on_no_answer_are_made_before_the_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """A bounded number of them; those beyond are made one by one, when the task before has its answer."""
    monkeypatch.setattr(drive_module, "MADE_FIRST_MAX", 3)
    made: list[int] = []

    def wanted() -> Iterator[float]:
        for number in itertools.count():
            made.append(number)
            yield float(number)

    seen: list[int] = []
    script.act = lambda _: seen.append(len(made))
    config, own = RobotConfig(task="m:f", sizes=("constant:0",), tasks=6), OwnRecord()
    with offloader(OnboardRunner(), observers=[own]) as offload:
        Drive(config, Calls(scripted, wanted()), offload, own, lambda _: None).run()
    assert seen == [3, 3, 3, 4, 5, 6]


def test_open_arrivals_keep_their_due_instants(tmp_path: Path) -> None:
    """Behind a slow task the others begin late, after it; when they were due does not move."""
    released = threading.Event()
    script.act = lambda number: released.wait(0.2) if number == 0 else None
    lines, said = drive(tmp_path, tasks=15, arrivals="constant", rate=200.0, in_flight=1)
    assert [line["due_s"] for line in lines] == [n / 200.0 for n in range(15)]
    assert all(line["began_s"] >= line["due_s"] for line in lines)
    assert all(line["began_s"] >= lines[0]["ended_s"] for line in lines[1:])
    late = sorted(line["began_s"] - line["due_s"] for line in lines)
    over = sum(seconds > 0.01 for seconds in late)
    wanted = f"began over 10 ms after they were due: {over} of 15; P95 of all {late[14] * 1e3:.1f} ms"
    assert said[-1] == wanted
    assert over >= 14


def test_open_arrivals_do_not_wait_for_answers(tmp_path: Path) -> None:
    """Task 0 ends only after all others have run: they are asked for meanwhile."""
    others = threading.Semaphore(0)

    def act(number: int) -> bool:
        if number == 0:
            return all(others.acquire(timeout=WAIT_S) for _ in range(7))
        others.release()
        return True

    script.act = act
    lines, _ = drive(tmp_path, tasks=8, arrivals="poisson", rate=1000.0, in_flight=2)
    assert {line["i"] for line in lines} == set(range(8))
    assert [line["answer"] for line in lines] == [answers_file.of_value(True, ())] * 8
    assert {line["id"].partition("-")[2] for line in lines} == {str(n) for n in range(8)}
    assert len({line["id"].partition("-")[0] for line in lines}) == 1


def test_the_ids_are_of_the_own_records(tmp_path: Path) -> None:
    """With eight tasks at a time each answer's id is that of the record with its size."""
    records: list[Record] = []
    barrier = threading.Barrier(8)
    script.act = lambda _: barrier.wait(WAIT_S) and None
    config = RobotConfig(
        task="m:f", sizes=("constant:0",), tasks=40, arrivals="bursts", rate=4000.0, burst=8, in_flight=8
    )
    answers, own = Answers(tmp_path / "answers.jsonl"), OwnRecord()
    with offloader(OnboardRunner(8), observers=[own, records.append]) as offload:
        work = Calls(scripted, map(float, itertools.count()))
        Drive(config, work, offload, own, lambda _: None, answers=answers).run()
    answers.close()
    sizes = {record.id: record.size for record in records}
    lines = list(answers_file.read(tmp_path / "answers.jsonl"))
    assert len(lines) == 40
    assert all(sizes[line["id"]] == line["i"] for line in lines)


def test_no_more_than_so_many_are_in_flight(tmp_path: Path) -> None:
    """All due at once: exactly three run at a time, never a fourth."""
    barrier = threading.Barrier(3)
    script.act = lambda _: barrier.wait(WAIT_S) and None
    settings = {"arrivals": "bursts", "rate": 1000.0, "burst": 12}
    lines, _ = drive(tmp_path, tasks=12, in_flight=3, **settings)
    assert {line["due_s"] for line in lines} == {0.0}
    assert [line["error"] for line in lines] == [None] * 12
    assert script.most == 3


@pytest.mark.parametrize("settings", [{}, {"arrivals": "poisson", "rate": 500.0}], ids=["closed", "open"])
def test_a_failing_task_does_not_end_the_run(tmp_path: Path, settings: dict[str, Any]) -> None:
    """Its line has the error and its record's id, no answer; the others are as ever."""

    def act(number: int) -> Any:
        if number == 3:
            raise ValueError("three")
        return object() if number == 5 else number

    script.act = act
    lines, said = drive(tmp_path, tasks=10, **settings)
    lines.sort(key=lambda line: int(line["i"]))
    assert [line["i"] for line in lines] == list(range(10))
    assert lines[3]["error"] == "TaskFailed: ValueError: three"
    assert lines[5]["error"].startswith("BadValue: a value of type builtins.object")
    assert [line["answer"] is None for line in lines] == [n in (3, 5) for n in range(10)]
    assert all(line["id"] for line in lines)
    assert said[0] == "8 tasks answered; 2 failed"


@pytest.mark.parametrize("settings", [{}, {"arrivals": "poisson", "rate": 500.0}], ids=["closed", "open"])
def test_without_answers_a_failure_ends_the_run(settings: dict[str, Any]) -> None:
    """The task's own failure is the caller's, and no later task is asked for long."""

    def act(number: int) -> None:
        if number == 3:
            raise ValueError("three")

    script.act = act
    config = RobotConfig(task="m:f", sizes=("constant:0",), tasks=10_000, in_flight=2, **settings)
    own = OwnRecord()
    with offloader(OnboardRunner(), observers=[own]) as offload:
        work = Calls(scripted, map(float, itertools.count()))
        with pytest.raises(TaskFailed, match="three"):
            Drive(config, work, offload, own, lambda _: None).run()
    assert len(script.asked) < 100


@pytest.mark.parametrize("settings", [{}, {"arrivals": "constant", "rate": 500.0}], ids=["closed", "open"])
def test_answered_tasks_are_not_asked_again(tmp_path: Path, settings: dict[str, Any]) -> None:
    """A run on a file with answers asks for the missing tasks with their own numbers, each once."""
    path = tmp_path / "answers.jsonl"
    drive(tmp_path, tasks=12, **settings)
    kept = [line for line in path.read_text().splitlines() if answers_number(line) not in (2, 5, 6)]
    path.write_text("".join(f"{line}\n" for line in kept[:7]))
    there = {answers_number(line) for line in kept[:7]}
    script.asked.clear()
    lines, said = drive(tmp_path, tasks=15, **settings)
    missing = [n for n in range(15) if n not in there]
    assert sorted(script.asked) == missing
    assert sorted(line["i"] for line in lines) == list(range(15))
    values = {line["i"]: line["answer"] for line in lines}
    assert values == {n: answers_file.of_value(n, ()) for n in range(15)}
    assert said[:2] == ["7 of 15 tasks had their answer before", "8 tasks answered"]
    if settings:  # the first missing task is due at once, the others as far after it as ever
        dues = {line["i"]: line["due_s"] for line in lines[7:]}
        assert dues == pytest.approx({n: (n - missing[0]) / 500.0 for n in missing})


def answers_number(line: str) -> int:
    return int(line.partition('"i":')[2].partition(",")[0])


def test_a_stopped_run_answers_nothing_that_it_gave_up(tmp_path: Path) -> None:
    """Ctrl-C with tasks in flight and waiting: only what was answered before is in the file."""
    closed, path = threading.Event(), tmp_path / "answers.jsonl"

    class Onboard(OnboardRunner):
        def close(self) -> None:
            closed.set()
            super().close()

    ran = itertools.count()  # four threads ask: which tasks come first is theirs to say

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
    config = RobotConfig(
        task="m:f", sizes=("constant:0",), tasks=100, in_flight=4, arrivals="constant", rate=1000.0
    )
    answers, own = Answers(path), OwnRecord()
    with offloader(Onboard(), observers=[own]) as offload:
        work = Calls(scripted, map(float, itertools.count()))
        run = Drive(config, work, offload, own, lambda _: None, answers=answers)
        with pytest.raises(KeyboardInterrupt):
            run.run()
    answers.close()
    assert [line["error"] for line in answers_file.read(path)] == [None, None]


def test_tasks_are_made_ahead_in_order_and_bounded() -> None:
    """So many wait ready made; what making raises reaches whoever asks for that task."""
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


def referenced(
    folder: Path, cloud: ScriptedRunner, tasks: int, every: int
) -> tuple[list[dict[str, Any]], list[Record]]:
    """The reference lines of a closed run, and the run's own records."""
    config = RobotConfig(
        task="m:f",
        sizes=("constant:0",),
        tasks=tasks,
        reference=every,
        cloud="tcp://cloud:5555",
        trace=folder / "t",
        seed=5,
    )
    path, own, records = folder / "t.reference.jsonl", OwnRecord(), list[Record]()
    with (
        offloader(ScriptedRunner(CLOUD, lambda one: Execution(CLOUD, 0.25, one.args[0])), OnboardRunner(),
                  observers=[own, records.append]) as offload,
        offloader(cloud, OnboardRunner()) as again,
    ):  # fmt: skip
        references = References(path, again, [ONBOARD, CLOUD], every=every, tasks=tasks, seed=5)
        work = Calls(scripted, map(float, itertools.count()))
        Drive(config, work, offload, own, lambda _: None, references=references).run()
        references.close()
        assert again._memories.of(kind_of(scripted), []).sites.keys() == {ONBOARD, CLOUD} or cloud.absent
    return list(references_file.read(path)), records


def test_every_third_task_has_a_reference(tmp_path: Path) -> None:
    """Tasks 2, 5, 8, 11 run again on each site alone, in turning order; the run records nothing of it."""
    asked: list[int] = []

    def answer(one: Task) -> Execution:
        asked.append(len(script.asked))
        return Execution(CLOUD, 0.5, one.args[0])

    lines, records = referenced(tmp_path, ScriptedRunner(CLOUD, answer), 13, 3)
    assert [line["i"] for line in lines] == [2, 5, 8, 11]
    assert [record.size for record in records] == list(range(13))
    for line in lines:
        record = records[line["i"]]
        assert (line["v"], line["used"], line["chosen"]) == (1, record.used, record.decision.site)
        assert line["both"] == record.decision.both
        assert line["waited_s"] >= record.waited_s
        assert line["sites"].keys() == {ONBOARD, CLOUD}
        assert line["sites"][CLOUD] == {"seconds": 0.5, "ok": True, "censored": False}
        assert line["sites"][ONBOARD]["ok"]
    # `scripted` runs onboard: in warm-up (both) and in each reference, before or after the cloud's turn.
    first = [order[0] for order in orders(4, 5, [ONBOARD, CLOUD])]
    assert sorted(first) == [CLOUD, CLOUD, ONBOARD, ONBOARD]
    twice = [number for number, count in Counter(script.asked).items() if count == 2]
    assert [script.asked[at - 1] for at, way in zip(asked, first, strict=True) if way == ONBOARD] == [
        number for number, way in zip((2, 5, 8, 11), first, strict=True) if way == ONBOARD
    ]
    assert set(twice) <= {2, 5, 8, 11}


def test_a_reference_says_what_went_wrong(tmp_path: Path) -> None:
    """A cloud that does not answer is there with its lost time; one that cannot take the task is absent."""
    late = Execution(CLOUD, 2.0, failure=CloudTimeout("late"), censored=True)
    lines, _ = referenced(tmp_path, ScriptedRunner(CLOUD, lambda _: late), 4, 2)
    assert [line["sites"][CLOUD] for line in lines] == [{"seconds": 2.0, "ok": False, "censored": True}] * 2
    assert all(line["sites"][ONBOARD]["ok"] for line in lines)
    away = ScriptedRunner(CLOUD, lambda _: late, unavailable="away")
    (tmp_path / "away").mkdir()
    lines, _ = referenced(tmp_path / "away", away, 4, 2)
    assert [list(line["sites"]) for line in lines] == [[ONBOARD]] * 2


def test_warming_changes_no_task() -> None:
    """The warm-up asks for the first task on all sites, by another offloader; the run asks for it again."""
    cloud = ScriptedRunner(CLOUD, lambda one: Execution(CLOUD, 0.1, one.args[0]))
    config = RobotConfig(task="m:f", sizes=("constant:0",), tasks=3)
    own = OwnRecord()
    with offloader(cloud, OnboardRunner()) as unseen, offloader(OnboardRunner(), observers=[own]) as offload:
        run = Drive(config, Calls(scripted, map(float, itertools.count())), offload, own, lambda _: None)
        run.warm(unseen)
        assert [one.args for one in cloud.tasks] == [(0,)]
        assert script.asked == [0]
        run.run()
    assert script.asked == [0, 0, 1, 2]
    assert len(cloud.tasks) == 1
