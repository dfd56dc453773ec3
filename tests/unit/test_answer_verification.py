"""Verifying the answers of a run: right answers pass, and for a wrong one it says what is wrong."""

import itertools
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from offboard.common.errors import OffloadError
from offboard.common.planning.planner import plan_path
from offboard.common.task_states import TaskStates
from offboard.loadgen.play.answer_verification import (
    NEEDS_SAME,
    RETURNS_NOTHING,
    _repeated,
    verified,
    wrong_plan,
)
from offboard.loadgen.robot import answers
from offboard.loadgen.robot.work import make_work
from offboard.loadgen.scenario.outcome import Answered
from offboard.loadgen.scenario.scenario import Workload
from tests import frames

MAP = Path(__file__).parents[1] / "samples" / "32room_000-crop.map"
SEED = 3
PLANS = Workload(map=MAP, tasks=8, jump=True, obstacles=4, radius_m=0.0)
CALLS = Workload(task="offboard.loadgen.scenario.hash_tasks:hash_rounds", sizes=("uniform:10:1000",), tasks=8)
INPUTS = Workload(task="tests.frames:brightness", inputs="tests.frames:frames", tasks=8)
VARIANTS = Workload(task="tests.variant_tasks:sort_out", sizes=("uniform:10:1000",), tasks=8)
PACKED = Workload(task="tests.packing_tasks:two", sizes=("uniform:10:1000",), tasks=8)
LARGE = replace(INPUTS, task="tests.frames:copied")


def answered_rightly(workload: Workload) -> list[Answered]:
    """The tasks of the workload, each with its right answer."""
    work = make_work(workload.robot(SEED))
    found = []
    for i in range(workload.tasks):
        answer = work.describe(work.function(*work.request()))
        found.append(Answered(i, "robot", 0.0, 0.1, None, answer, "cloud", False, ("cloud",)))
        work.advance(None)
    return found


@pytest.mark.parametrize("workload", [PLANS, CALLS, INPUTS], ids=["plans", "calls", "inputs"])
def test_right_answers_pass_in_any_order(workload: Workload) -> None:
    """Answers may be missing, as after a crash, and a failed task has no answer to be wrong."""
    found = answered_rightly(workload)
    failed = replace(found[2], error="TaskFailed: no", answer=None)
    judged = verified([found[7], failed, found[0], found[5]], workload, SEED)
    assert [(one.i, one.wrong) for one in judged] == [(0, None), (2, None), (5, None), (7, None)]


@pytest.mark.parametrize("workload", [PLANS, CALLS, INPUTS], ids=["plans", "calls", "inputs"])
def test_the_answer_of_another_task_is_wrong(workload: Workload) -> None:
    """An answer that belongs to another task is found to be wrong."""
    found = answered_rightly(workload)
    judged = verified([replace(found[3], answer=found[4].answer)], workload, SEED)
    assert judged[0].wrong is not None


def test_an_answer_is_compared_with_that_of_the_variant_that_gave_it() -> None:
    """What onboard answers rightly would be wrong from the cloud."""
    work = make_work(VARIANTS.robot(SEED))
    (number,) = work.request()
    right = work.describe(f"onboard {number}")
    one = Answered(0, "robot", 0.0, 0.1, None, right, "onboard", False, ("onboard",))
    onboard, cloud = (verified([replace(one, used=site)], VARIANTS, SEED)[0] for site in ("onboard", "cloud"))
    assert onboard.wrong is None
    assert cloud.wrong is not None


@pytest.mark.parametrize(
    ("mean", "wrong"),
    [
        (lambda right: right + 0.9 * frames.BRIGHTER, None),
        (lambda right: right + 1.1 * frames.BRIGHTER, "{'mean': .*}, but {'mean': .*} was expected"),
        (lambda _: "bright", "{'mean': 'bright'} cannot be compared: TypeError: "),
        (lambda right: np.array([right, right]), r"{'mean': array\(.*\)} cannot be compared: ValueError: "),
    ],
)
def test_answers_may_differ_within_the_tolerance_of_their_task(mean: Any, wrong: str | None) -> None:
    """`same` of the module of the task decides about an answer with other bytes."""
    right = answered_rightly(INPUTS)[3]
    (frame,) = list(itertools.islice(frames.frames(SEED), 4))[3:]
    answer = answers.of_value({"mean": mean(frames.brightness(frame)["mean"])}, (), whole=True)
    (judged,) = verified([replace(right, answer=answer)], INPUTS, SEED)
    assert judged.unverified is None
    assert (judged.wrong is None) == (wrong is None)
    assert wrong is None or re.match(wrong, judged.wrong or "")


def test_a_comparison_that_returns_nothing_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """A `same` without `return` would make each answer with other bytes wrong, and nobody would know why."""
    right = answered_rightly(INPUTS)[3]
    monkeypatch.setattr(frames, "same", lambda *_: None)
    _repeated.cache_clear()
    answer = answers.of_value({"mean": 0.0}, (), whole=True)
    (judged,) = verified([replace(right, answer=answer)], INPUTS, SEED)
    _repeated.cache_clear()
    assert judged.wrong is not None
    assert judged.wrong.endswith("cannot be compared: TypeError: " + RETURNS_NOTHING)


@pytest.mark.parametrize("used", ["cloud", "onboard"])
def test_the_wrong_answer_of_a_task_that_packs_names_packing(used: str) -> None:
    """Only an answer of a server was computed from packed arguments."""
    found = answered_rightly(PACKED)
    (judged,) = verified([replace(found[3], answer=found[4].answer, used=used)], PACKED, SEED)
    assert judged.wrong is not None
    assert judged.wrong.endswith(NEEDS_SAME) == (used == "cloud")


def test_an_answer_that_is_too_large_to_compare_is_not_verified() -> None:
    """An answer over 16 KiB with the expected digest is right; with another one it is not verified."""
    found = answered_rightly(LARGE)
    judged = verified([found[1], replace(found[2], answer=found[3].answer)], LARGE, SEED)
    assert [one.wrong for one in judged] == [None, None]
    why = "its bytes differ, and an answer over 16384 bytes is not kept"
    assert [one.unverified for one in judged] == [None, why]


def test_each_call_is_repeated_once_for_all_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """A later run with the same tasks is judged in the same way, and only calls that are new run."""
    workload, ran = replace(CALLS, sizes=("uniform:20:2000",)), []
    found = answered_rightly(workload)
    call = TaskStates.call

    def counted(states: TaskStates, kind: Any, args: Any) -> Any:
        ran.append(args)
        return call(states, kind, args)

    monkeypatch.setattr(TaskStates, "call", counted)
    verified([found[1], found[3]], workload, SEED)
    judged = verified([found[0], replace(found[1], answer=found[2].answer), found[3]], workload, SEED)
    assert [one.wrong is None for one in judged] == [True, False, True]
    assert len(ran) == 3


def test_a_task_that_fails_without_offboard_is_named() -> None:
    """An answer cannot be verified if the function raises in the bench process."""
    found = answered_rightly(CALLS)[:1]
    wrong = replace(CALLS, sizes=("constant:1e9",))
    with pytest.raises(
        OffloadError, match="task 0 fails without Offboard: ValueError: 1000000000 rounds are"
    ):
        verified(found, wrong, SEED)


def test_tasks_that_cannot_be_made_again_are_not_verified() -> None:
    """If the next task depends on the previous answer, the tasks cannot be made again from the seed."""
    found = [replace(answered_rightly(PLANS)[0], answer={"status": "nonsense"})]
    assert verified(found, replace(PLANS, jump=False), SEED) == found


@pytest.fixture
def asked() -> tuple[Any, Any, dict[str, Any]]:
    """A request with a path of more than ten cells, its plan, and its right answer."""
    work = make_work(PLANS.robot(SEED))
    while True:
        request = work.request()
        plan = plan_path(*request)
        if len(plan.cells) > 10:
            return request, plan, answers.of_plan(plan)
        work.advance(None)


def changed(plan: Any, cells: Any) -> dict[str, Any]:
    return answers.of_plan(replace(plan, cells=cells.astype(np.int32)))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda _plan, answer: answer | {"status": "NO_PATH"}, "status NO_PATH, but NONE was expected"),
        (lambda _plan, answer: answer | {"cost": answer["cost"] * 1.01}, "cost .*, but the path is .* long"),
        (lambda plan, _answer: changed(plan, plan.cells[::-1]), "does not join the robot and its goal"),
        (lambda plan, _answer: changed(plan, plan.cells[:-1]), "does not join the robot and its goal"),
        (lambda plan, _answer: changed(plan, there_and_back(plan.cells)), "cost .*, but the path is"),
        (
            lambda plan, answer: {
                **changed(plan, there_and_back(plan.cells)),
                "cost": answer["cost"] + 2 * float(np.linalg.norm(plan.cells[1] - plan.cells[0])),
            },
            "m long, but .* m was expected",
        ),
    ],
)
def test_a_wrong_path_is_found(asked: Any, change: Any, said: str) -> None:
    """A wrong status, start, end, cost or length is found and named."""
    request, plan, answer = asked
    assert wrong_plan(answer, plan, request) is None
    wrong = wrong_plan(change(plan, answer), plan, request)
    assert wrong is not None
    assert re.search(said, wrong), wrong


def there_and_back(cells: Any) -> Any:
    """The same path, with its first step taken there, back, and there again."""
    return np.concatenate([cells[:2], cells[:1], cells[1:]])


def test_a_path_through_a_wall_is_found(asked: Any) -> None:
    """A path through an occupied cell is wrong, and the message names the cell."""
    request, plan, answer = asked
    grid = request[0]
    blocked = grid.cells.copy()
    middle = plan.cells[len(plan.cells) // 2]
    blocked[tuple(middle)] = 100
    walled = (replace(grid, cells=blocked), *request[1:])
    wrong = wrong_plan(answer, plan, walled)
    assert wrong == f"the path crosses {tuple(middle)}, where the robot does not fit"
