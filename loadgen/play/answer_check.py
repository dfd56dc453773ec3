"""Whether the answers of a run are right: every path against the map and what the robot saw, cell by cell.

The tasks are made again from their seed; nothing is taken from the run but its answers.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.common.planning.grid_kernels import covered
from offboard.common.planning.maps import GridMap, passable
from offboard.common.planning.planner import Plan, scan_hits
from offboard.loadgen.scenario.outcome import Answered
from offboard.loadgen.scenario.scenario import Workload
from offboard.robot_client.simulated import answers
from offboard.robot_client.simulated.task_source import Work, make_work

COST_SHARE = 1e-6  # two sums of the same steps differ by no more


def verified(answered: Sequence[Answered], workload: Workload, seed: int) -> list[Answered]:
    """The same with `wrong` filled in, where the tasks do not depend on answers and can be made again."""
    if not workload.known()["jump"]:
        return list(answered)
    work, at = make_work(workload.robot(seed)), 0
    found = []
    for one in sorted(answered, key=lambda one: one.i):
        while at < one.i:
            work.advance(None)
            at += 1
        found.append(replace(one, wrong=None if one.error is not None else _wrong(work, one.answer)))
    return found


def _wrong(work: Work, answer: Mapping[str, Any]) -> str | None:
    request = work.request()
    expected = work.function(*request)
    if isinstance(expected, Plan):
        return wrong_plan(answer, expected, request)
    described = work.describe(expected)
    return None if answer == described else f"{answer} where {described} was expected"


def wrong_plan(answer: Mapping[str, Any], expected: Plan, request: Sequence[Any]) -> str | None:
    """What is wrong with a path that was answered, None where it is as short and as free as can be."""
    if answer["status"] != expected.status:
        return f"status {answer['status']} where {expected.status} was expected"
    if expected.status != "NONE":
        return None
    grid, _scan, pose, goal, *_ = request
    cells = answers.cells_of(answer)
    if [tuple(cells[0]), tuple(cells[-1])] != [grid.cell(pose.x, pose.y), grid.cell(goal.x, goal.y)]:
        return f"a path from {tuple(cells[0])} to {tuple(cells[-1])}: not from the robot to its goal"
    blocked = _blocked(request, cells)
    if blocked is not None:
        return blocked
    cost = float(np.linalg.norm(np.diff(cells, axis=0), axis=1).sum()) * grid.resolution
    if abs(cost - answer["cost"]) > COST_SHARE * cost:
        return f"cost {answer['cost']} of a path that is {cost} m long"
    if abs(cost - expected.cost) > COST_SHARE * cost:
        return f"a path of {cost} m where one of {expected.cost} m was expected"
    return None


def _blocked(request: Sequence[Any], cells: NDArray[np.int32]) -> str | None:
    """The first cell after the robot's own that it must not enter: no map, a wall, or seen occupied."""
    grid, scan, pose, _goal, radius_m, *_ = request
    rows, cols = cells[1:, 0], cells[1:, 1]
    if not ((cells >= 0) & (cells < grid.cells.shape)).all():
        return "a path off the map"
    free = _passable(grid, radius_m)[rows, cols]
    if not free.all():
        return f"a path through {tuple(cells[1:][~free][0])}, where the robot does not fit"
    hits = scan_hits(grid, scan, pose, radius_m)
    seen = covered(rows, cols, hits.rows, hits.cols, hits.reach)
    if seen < len(rows):
        return f"a path through {tuple(cells[1 + seen])}, which the scan saw occupied"
    return None


_room: dict[tuple[int, float], tuple[GridMap, NDArray[np.bool_]]] = {}


def _passable(grid: GridMap, radius_m: float) -> NDArray[np.bool_]:
    """Where a robot of this radius fits, kept for the map that is verified now."""
    key = (id(grid), radius_m)
    if key not in _room:
        _room.clear()
        _room[key] = (grid, passable(grid, radius_m))
    return _room[key][1]
