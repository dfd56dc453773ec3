"""Verifying the answers of a run: right answers pass, and for a wrong one it says what is wrong."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from offboard.common.planning.planner import plan_path
from offboard.loadgen.play.answer_verification import verified, wrong_plan
from offboard.loadgen.scenario.outcome import Answered
from offboard.loadgen.scenario.scenario import Workload
from offboard.robot_client.simulated import answers
from offboard.robot_client.simulated.work import make_work

MAP = Path(__file__).parents[1] / "samples" / "32room_000-crop.map"
SEED = 3
PLANS = Workload(map=MAP, tasks=8, jump=True, obstacles=4, radius_m=0.0)
CALLS = Workload(task="offboard.loadgen.scenario.hash_tasks:hash_rounds", sizes=("uniform:10:1000",), tasks=8)


def answered_rightly(workload: Workload) -> list[Answered]:
    """The tasks of the workload, each with its right answer."""
    work = make_work(workload.robot(SEED))
    found = []
    for i in range(workload.tasks):
        answer = work.describe(work.function(*work.request()))
        found.append(Answered(i, "robot", 0.0, 0.1, None, answer, "cloud", False, ("cloud",)))
        work.advance(None)
    return found


@pytest.mark.parametrize("workload", [PLANS, CALLS], ids=["plans", "calls"])
def test_right_answers_pass_in_any_order(workload: Workload) -> None:
    """Answers may be missing, as after a crash, and a failed task has no answer to be wrong."""
    found = answered_rightly(workload)
    failed = replace(found[2], error="TaskFailed: no", answer=None)
    judged = verified([found[7], failed, found[0], found[5]], workload, SEED)
    assert [(one.i, one.wrong) for one in judged] == [(0, None), (2, None), (5, None), (7, None)]


@pytest.mark.parametrize("workload", [PLANS, CALLS], ids=["plans", "calls"])
def test_the_answer_of_another_task_is_wrong(workload: Workload) -> None:
    """An answer that belongs to another task is found to be wrong."""
    found = answered_rightly(workload)
    judged = verified([replace(found[3], answer=found[4].answer)], workload, SEED)
    assert judged[0].wrong is not None


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
