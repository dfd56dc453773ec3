"""Verifies the answers of a run: repeats each task without Offboard, and compares the answers.

A path is checked cell by cell against map and scan. The tasks are made again from the seed, so that only the
answers are taken from the run.
"""

import functools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.common.errors import OffloadError, describe
from offboard.common.planning.grid_kernels import covered
from offboard.common.planning.maps import GridMap, passable
from offboard.common.planning.planner import Plan, scan_hits
from offboard.common.task_states import TaskStates
from offboard.common.tasks import Kind, kind_of
from offboard.loadgen.robot import answers
from offboard.loadgen.robot.calls import Calls
from offboard.loadgen.robot.work import make_work
from offboard.loadgen.scenario.outcome import Answered
from offboard.loadgen.scenario.scenario import Workload
from offboard.robot_client.sites.runner import ONBOARD

COST_SHARE = 1e-6  # largest relative difference of two sums of the same steps
NEEDS_SAME = (
    "the task packs its arguments for servers: if packing loses detail, right answers may differ, and the "
    "module of the task needs a function same(a, b) that compares them (docs/own_task.md, Send less)"
)

RETURNS_NOTHING = "same(a, b) returned None, and must return whether they are equal"


def verified(answered: Sequence[Answered], workload: Workload, seed: int) -> list[Answered]:
    """The same tasks with `wrong` and `unverified` filled in; unchanged if the tasks cannot be made again.

    That is so if the next task depends on the previous answer (a map without `jump`), and for the steps of a
    stream.
    """
    if workload.streams or not workload.known()["jump"]:
        return list(answered)
    tasks = _repeated(workload, seed)
    ordered = sorted(answered, key=lambda one: one.i)
    return [one if one.error is not None else tasks.judged(one) for one in ordered]


class _Repeated:
    """The tasks of a workload and seed, made again and run without Offboard.

    The right answers of calls are kept, so each variant of a call runs once, even if many runs with the same
    tasks are verified. Plans are not kept, because a path is checked against its whole request.
    """

    def __init__(self, workload: Workload, seed: int) -> None:
        self._config = workload.robot(seed)
        self._states = TaskStates(workers=1)
        self._work, self._at = make_work(self._config), 0
        # Described answers, by the number of the task and the name of the kind or variant.
        self._right: dict[tuple[int, str], dict[str, Any]] = {}

    def judged(self, one: Answered) -> Answered:
        """The answer with `wrong` or `unverified` filled in."""
        kind = kind_of(self._work.function).at(one.used or ONBOARD)
        if (one.i, kind.name) not in self._right:
            request, expected = self._run(one.i, kind)
            if isinstance(expected, Plan):
                return replace(one, wrong=wrong_plan(one.answer, expected, request))
            self._right[one.i, kind.name] = self._work.describe(expected)
        described = self._right[one.i, kind.name]
        if one.answer["sha256"] == described["sha256"]:
            return one
        if isinstance(self._work, Calls) and self._work.same is not None:
            return _compared(one, self._work, described)
        wrong = f"{one.answer}, but {described} was expected"
        if kind.pack is not None and (one.used or ONBOARD) != ONBOARD:
            wrong += f"; {NEEDS_SAME}"
        return replace(one, wrong=wrong)

    def _run(self, i: int, kind: Kind) -> tuple[tuple[Any, ...], Any]:
        """The request of task `i` and its right answer by this kind."""
        if i < self._at:
            self._work, self._at = make_work(self._config), 0
        while self._at < i:
            self._work.advance(None)
            self._at += 1
        request = self._work.request()
        try:
            return request, self._states.call(kind, request)
        except Exception as error:
            raise OffloadError(f"task {i} fails without Offboard: {describe(error)}") from error


_repeated = functools.lru_cache(maxsize=1)(_Repeated)  # a comparison plays the same tasks with each policy


def _compared(one: Answered, work: Calls, expected: dict[str, Any]) -> Answered:
    """Ask the module of the task whether two answers with different bytes are the same."""
    if "frames" not in one.answer or "frames" not in expected:
        too_large = f"its bytes differ, and an answer over {answers.WHOLE_BYTES_MAX} bytes is not kept"
        return replace(one, unverified=too_large)
    found, wanted = work.restore(one.answer), work.restore(expected)
    assert work.same is not None
    try:
        said = work.same(found, wanted)
        if said is None:
            raise TypeError(RETURNS_NOTHING)
        same = bool(said)  # of an array, this raises
    except Exception as error:  # noqa: BLE001 - a wrong answer may be of a type that `same` does not expect
        return replace(one, wrong=f"{found!r:.200} cannot be compared: {describe(error)}")
    return one if same else replace(one, wrong=f"{found!r:.200}, but {wanted!r:.200} was expected")


def wrong_plan(answer: Mapping[str, Any], expected: Plan, request: Sequence[Any]) -> str | None:
    """What is wrong with an answered path; None if it is free of obstacles and as short as expected."""
    if answer["status"] != expected.status:
        return f"status {answer['status']}, but {expected.status} was expected"
    if expected.status != "NONE":
        return None
    grid, _scan, pose, goal, *_ = request
    cells = answers.cells_of(answer)
    if [tuple(cells[0]), tuple(cells[-1])] != [grid.cell(pose.x, pose.y), grid.cell(goal.x, goal.y)]:
        return f"the path from {tuple(cells[0])} to {tuple(cells[-1])} does not join the robot and its goal"
    blocked = _blocked(request, cells)
    if blocked is not None:
        return blocked
    cost = float(np.linalg.norm(np.diff(cells, axis=0), axis=1).sum()) * grid.resolution
    if abs(cost - answer["cost"]) > COST_SHARE * cost:
        return f"cost {answer['cost']}, but the path is {cost} m long"
    if abs(cost - expected.cost) > COST_SHARE * cost:
        return f"the path is {cost} m long, but {expected.cost} m was expected"
    return None


def _blocked(request: Sequence[Any], cells: NDArray[np.int32]) -> str | None:
    """The first cell that the robot must not enter: off the map, too near to a wall, or occupied in the scan.

    The robot's own cell is not checked.
    """
    grid, scan, pose, _goal, radius_m, *_ = request
    rows, cols = cells[1:, 0], cells[1:, 1]
    if not ((cells >= 0) & (cells < grid.cells.shape)).all():
        return "the path leaves the map"
    free = _passable(grid, radius_m)[rows, cols]
    if not free.all():
        return f"the path crosses {tuple(cells[1:][~free][0])}, where the robot does not fit"
    hits = scan_hits(grid, scan, pose, radius_m)
    seen = covered(rows, cols, hits.rows, hits.cols, hits.reach)
    if seen < len(rows):
        return f"the path crosses {tuple(cells[1 + seen])}, which is occupied in the scan"
    return None


@functools.lru_cache(maxsize=1)  # for one map and robot
def _passable(grid: GridMap, radius_m: float) -> NDArray[np.bool_]:
    """Where a robot of this radius fits."""
    return passable(grid, radius_m)
