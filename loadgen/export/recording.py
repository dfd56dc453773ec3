"""What a robot on a map asked for and got, task by task, from its trace, its answers and its drive record.

No file of a run holds scans, poses and goals: the robot is driven again, along the paths of the answers, and
each task is checked against the trace. How tasks look in a file is left to `mcap_file`.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from math import isclose
from pathlib import Path
from typing import Any

import numpy as np

from offboard.common import VERSION
from offboard.common.config import from_table
from offboard.common.errors import DataError
from offboard.common.planning.maps import GridMap
from offboard.common.planning.planner import Plan, size_of_plan
from offboard.loadgen.drive_record import DriveRecord
from offboard.loadgen.robot import answers
from offboard.loadgen.robot.config import DriveConfig
from offboard.loadgen.robot.robot import Request
from offboard.loadgen.robot.work import make_plans
from offboard.loadgen.robot_files import drive_path, read_trace

SAME_SIZE = 1e-9  # relative difference of two sizes that are the same

Lines = Mapping[Any, Mapping[str, Any]]


@dataclass(frozen=True, slots=True)
class Decided:
    """What the trace says of one task. Times are in milliseconds; by site, those that are known.

    site: where the task was sent.
    used: the site whose answer was used; None if the task failed.
    """

    size: float
    site: str
    reason: str
    policy: str
    used: str | None
    waited_ms: float
    predicted_ms: Mapping[str, float]
    true_ms: Mapping[str, float]


@dataclass(frozen=True, slots=True, eq=False)
class Asked:
    """One task of a robot: what it asked for, the line with its answer, and what the trace says.

    `begin_ns` and `end_ns` are in nanoseconds of Unix time.
    """

    request: Request
    line: Mapping[str, Any]
    decided: Decided
    begin_ns: int
    end_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """The tasks of a run in the order of their numbers, and the map of its robot.

    `left_out` counts the tasks of which not everything is known: trace or answers have no line of them, or of
    a task before them on which they depend.
    """

    grid: GridMap
    tasks: list[Asked]
    left_out: int


def read_recording(trace: Path) -> Recording:
    """Everything about the run of a trace; a DataError if it is not known, or does not fit together."""
    if not drive_path(trace).is_file():
        raise DataError(
            f"{drive_path(trace)}: no such file; `loadgen run` of a scenario with a map writes it, "
            "and so does `loadgen drive` with --trace and --answers"
        )
    drive = DriveRecord.read(trace)
    records = {str(record["id"]): record for record in read_trace(trace)}
    lines = {line["i"]: line for line in answers.read(drive.answers)}
    tasks = list(_driven_again(trace, drive, lines, records))
    if not tasks:
        raise DataError(f"{trace}: none of its tasks is in {drive.answers}")
    known = records.keys() | {str(line["id"] or line["i"]) for line in lines.values()}
    return Recording(drive.prior, tasks, left_out=len(known) - len(tasks))


def plan_of(line: Mapping[str, Any], grid: GridMap) -> Plan | None:
    """The plan in a line of the answers; None if the task failed."""
    if line["answer"] is None:
        return None
    answer, cells = line["answer"], answers.cells_of(line["answer"])
    metres = grid.metres(cells).astype(np.float32)
    return Plan(answer["status"], cells, metres, cost=answer["cost"], expanded=answer["expanded"])


def _driven_again(trace: Path, drive: DriveRecord, lines: Lines, records: Lines) -> Iterator[Asked]:
    """The tasks that have a line in both files.

    After a missing answer nothing is known, unless the robot jumps: nobody knows where it went.
    """
    config = from_table(DriveConfig, drive.settings, drive_path(trace), "settings")
    work = make_plans(config, drive.prior)
    zeros_ns: dict[str, int] = {}  # by the process that wrote answers: the Unix time when its clock was 0
    for number in range(max(lines, default=-1) + 1):
        line, plan = lines.get(number), None
        if line is None and not work.independent:
            return
        try:
            if line is not None:
                plan, record = plan_of(line, drive.prior), records.get(str(line["id"]))
                if record is not None:
                    task = _asked(work.request(), line, record, zeros_ns)
                    if not _fits(task, plan):
                        raise DataError(_misfit(trace, number, drive))
                    yield task
            work.advance(plan)
        except (LookupError, TypeError, ValueError, AttributeError) as error:
            raise DataError(f"{trace}: task {number}: its lines are wrong: {error!r}") from error


def _asked(
    request: Request, line: Mapping[str, Any], record: Mapping[str, Any], zeros_ns: dict[str, int]
) -> Asked:
    """The task of two lines. The trace says when its process began, the answers how much later each task.

    So a step of the wall clock during the run does not matter.
    """
    began_ns, ended_ns = (round(1e9 * line[name]) for name in ("began_s", "ended_s"))
    process = str(record["id"]).rpartition("-")[0]
    zero_ns = zeros_ns.setdefault(process, _unix_ns(record["started_at"]) - began_ns)
    return Asked(request, line, _decided(record), begin_ns=zero_ns + began_ns, end_ns=zero_ns + ended_ns)


def _decided(record: Mapping[str, Any]) -> Decided:
    decision = record["decision"]
    predicted_s = ((site, one["predicted_s"]) for site, one in record["sites"].items())
    return Decided(
        size=float(record["size"]),
        site=str(decision["site"]),
        reason=str(decision["reason"]),
        policy=str(decision["policy"]),
        used=record["used"],
        waited_ms=1e3 * float(record["waited_s"]),
        predicted_ms={site: 1e3 * float(one) for site, one in predicted_s if one is not None},
        true_ms={one["site"]: 1e3 * float(one["seconds"]) for one in record["executions"] if one["ok"]},
    )


def _fits(task: Asked, plan: Plan | None) -> bool:
    """Whether the trace has this task, and the path joins the robot and its goal."""
    grid, _, pose, goal, *_ = task.request
    if not isclose(size_of_plan(*task.request), task.decided.size, rel_tol=SAME_SIZE):
        return False
    if plan is None or not len(plan.cells):
        return True
    ends = [grid.cell(pose.x, pose.y), grid.cell(goal.x, goal.y)]
    return [tuple(plan.cells[0]), tuple(plan.cells[-1])] == ends


def _misfit(trace: Path, number: int, drive: DriveRecord) -> str:
    versions = f"it was {drive.software}, this is {VERSION}"
    return (
        f"{trace}: task {number} does not fit the robot that is driven again by {drive_path(trace).name}: "
        f"the files are of different runs, or another version of Offboard made them ({versions})"
    )


def _unix_ns(started_at: str) -> int:
    """The time of a record, which is in whole milliseconds."""
    return round(datetime.fromisoformat(started_at).timestamp() * 1e3) * 1_000_000
