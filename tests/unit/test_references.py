"""References: which tasks are run again on each site alone, and what is written about them."""

import itertools
import threading
from collections import Counter
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest

from offboard.common.errors import CloudTimeout
from offboard.common.task_states import TaskStates
from offboard.common.tasks import Kind, Task, kind_of, task
from offboard.loadgen.robot.calls import Calls
from offboard.loadgen.robot.config import CallConfig
from offboard.loadgen.robot.references import References, orders
from offboard.loadgen.robot.run import OwnRecord, Run
from offboard.loadgen.scenario.outcome_files import read_lines
from offboard.robot_client.records.record import Record
from offboard.robot_client.sites.onboard import OnboardRunner
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, Execution
from tests.fakes import ScriptedRunner
from tests.scripted import offloader, script, scripted

WAIT_S = 5.0  # for another thread; a test fails when it is over


@task("held", size=abs, setup=dict)
def held(state: dict[str, int], number: int) -> int:
    return number + len(state)


@pytest.fixture(autouse=True)
def fresh_script() -> None:
    script.reset()


def referenced(
    folder: Path, cloud: ScriptedRunner, tasks: int, every: int
) -> tuple[list[dict[str, Any]], list[Record]]:
    """The reference lines of a closed run, and the run's own records."""
    config = CallConfig(
        task="m:f",
        sizes=("constant:0",),
        tasks=tasks,
        reference=every,
        cloud="tcp://cloud:5555",
        trace=folder / "t",
        seed=5,
    )
    path, own, records = folder / "t.reference.jsonl", OwnRecord(), list[Record]()
    states = TaskStates(workers=1)
    with (
        offloader(ScriptedRunner(CLOUD, lambda one: Execution(CLOUD, 0.25, one.args[0])), OnboardRunner(),
                  observers=[own, records.append]) as offload,
        offloader(cloud, OnboardRunner()) as again,
    ):  # fmt: skip
        references = References(
            path, again, [ONBOARD, CLOUD], every=every, tasks=tasks, seed=5, states=states
        )
        work = Calls(scripted, zip(itertools.count()))
        Run(config, work, offload, own=own, say=lambda _: None, references=references).run()
        references.close()
    return read_lines(path), records


def test_every_third_task_has_a_reference(tmp_path: Path) -> None:
    """Tasks 2, 5, 8 and 11 run again on each site alone, in a changing order; the run has no record of it."""
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
    # `scripted` runs onboard in warm-up and in each reference, before or after the turn of the cloud.
    first = [order[0] for order in orders(4, 5, [ONBOARD, CLOUD])]
    assert sorted(first) == [CLOUD, CLOUD, ONBOARD, ONBOARD]
    twice = [number for number, count in Counter(script.asked).items() if count == 2]
    assert [script.asked[at - 1] for at, way in zip(asked, first, strict=True) if way == ONBOARD] == [
        number for number, way in zip((2, 5, 8, 11), first, strict=True) if way == ONBOARD
    ]
    assert set(twice) <= {2, 5, 8, 11}


def test_a_reference_holds_failures(tmp_path: Path) -> None:
    """A cloud that did not answer has its lost time; a cloud that could not take the task is left out."""
    late = Execution(CLOUD, 2.0, failure=CloudTimeout("late"), censored=True)
    lines, _ = referenced(tmp_path, ScriptedRunner(CLOUD, lambda _: late), 4, 2)
    assert [line["sites"][CLOUD] for line in lines] == [{"seconds": 2.0, "ok": False, "censored": True}] * 2
    assert all(line["sites"][ONBOARD]["ok"] for line in lines)
    away = ScriptedRunner(CLOUD, lambda _: late, unavailable="away")
    (tmp_path / "away").mkdir()
    lines, _ = referenced(tmp_path / "away", away, 4, 2)
    assert [list(line["sites"]) for line in lines] == [[ONBOARD]] * 2


def test_a_reference_does_not_wait_for_a_run_that_lost_its_race(tmp_path: Path) -> None:
    """Such a run may still use the one state of the robot; the reference begins when it has ended."""
    using, may_end, ended, seen = threading.Event(), threading.Event(), threading.Event(), list[bool]()

    class Watched(TaskStates):
        def lend(self, kind: Kind) -> AbstractContextManager[tuple[Any, ...]]:
            if threading.current_thread() is threading.main_thread():
                may_end.set()
            else:
                seen.append(ended.is_set())
            return super().lend(kind)

    states = Watched(workers=1)

    def lose() -> None:
        with TaskStates.lend(states, kind_of(held)):
            using.set()
            may_end.wait(WAIT_S)
            ended.set()

    with offloader(OnboardRunner(states=states)) as again:
        again(held, 1)
        assert again.last is not None
        references = References(tmp_path / "t", again, [ONBOARD], every=1, tasks=1, seed=1, states=states)
        loser = threading.Thread(target=lose)
        loser.start()
        assert using.wait(WAIT_S)
        references.measure(0, held, (2,), waited_s=0.1, record=again.last)
        loser.join(WAIT_S)
        references.close()
    assert seen == [False, True]
