"""Drives of a robot on a small map, onboard and without sockets."""

from pathlib import Path
from typing import Any

from offboard.common.planning.maps import GridMap
from offboard.common.planning.planner import Plan, Point, Pose, Scan, plan_path, size_of_plan
from offboard.common.tasks import task
from offboard.loadgen.robot.answers import Answers
from offboard.loadgen.robot.command import write_drive_record
from offboard.loadgen.robot.config import DriveConfig
from offboard.loadgen.robot.run import OwnRecord, Run
from offboard.loadgen.robot.work import Plans, make_work
from offboard.robot_client.records.trace import Trace
from offboard.robot_client.sites.onboard import OnboardRunner
from tests.scripted import offloader

MAP = Path(__file__).parent / "samples" / "32room_000-crop.map"


@task("picky_planner", size=size_of_plan, types=(GridMap, Scan, Pose, Point, Plan))
def picky_planner(grid: GridMap, scan: Scan, pose: Pose, goal: Point, *options: Any) -> Plan:
    """A planner that fails for every third column of goals."""
    if int(goal.x) % 3 == 0:
        raise ValueError(f"no goals in column {int(goal.x)}")
    return plan_path(grid, scan, pose, goal, *options)


def drive(folder: Path, *, picky: bool = False, tasks: int = 12, **settings: Any) -> list[tuple[Any, ...]]:
    """Let a robot ask for paths; it leaves trace.jsonl, answers.jsonl and the drive record in the folder.

    Returns the arguments of each task, as the robot asked for it.
    """
    trace, answers = folder / "trace.jsonl", folder / "answers.jsonl"
    config = DriveConfig(
        map=MAP, trace=trace, answers=answers, obstacles=4, radius_m=0.0, tasks=tasks, **settings
    )
    work, own, asked = make_work(config), OwnRecord(), []
    assert isinstance(work, Plans)
    write_drive_record(config, work)
    request = work.request

    def watched() -> tuple[Any, ...]:
        asked.append(request())
        return asked[-1]

    work.request = watched
    work.function = picky_planner if picky else plan_path
    kept, written = Trace(trace), Answers(answers)
    with offloader(OnboardRunner(), observers=[own, kept.write]) as offload:
        try:
            Run(config, work, offload, own=own, say=lambda _: None, answers=written).run()
        finally:
            written.close()
            kept.close()
    return asked
