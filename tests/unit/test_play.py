"""What a scenario's play hands to the robot, and what it clears away before."""

from pathlib import Path

import pytest

from common.config import load
from loadgen.play import make_room, robot_args
from loadgen.scenario import Scenario, Workload
from robot_client.config import RobotConfig
from robot_client.trace import alone_path

CLOUD = ("--cloud", "tcp://wan:5555")


def scenario(**workload: int) -> Scenario:
    return Scenario("small", 7, Workload(map=Path("m.yaml"), **workload))


def test_the_robot_gets_the_workload() -> None:
    """The robot's own settings are those of the scenario, its map and trace where the robot finds them."""
    args = robot_args(
        scenario(tasks=40, measure=30, alone=20), Path("/maps/m.yaml"), Path("/out/trace.jsonl")
    )
    robot = load(RobotConfig, [*args, *CLOUD], prog="", description="", environ={}, prefix="ROBOT")
    assert (robot.tasks, robot.measure, robot.alone, robot.seed) == (40, 30, 20, 7)
    assert (robot.map, robot.trace) == (Path("/maps/m.yaml"), Path("/out/trace.jsonl"))


def test_no_trace_of_an_earlier_run_is_left(tmp_path: Path) -> None:
    """Both go, also where the next run measures nothing alone; what else is there stays."""
    out = tmp_path / "new" / "out"
    trace = make_room(out)
    for path in (trace, alone_path(trace), out / "table.md"):
        path.write_text("old")
    assert make_room(out) == trace == out / "trace.jsonl"
    assert [path.name for path in out.iterdir()] == ["table.md"]


@pytest.mark.parametrize(("tasks", "alone"), [(None, 20), (50, 20), (6, 6)])
def test_fewer_tasks_mean_fewer_plans_alone(tasks: int | None, alone: int) -> None:
    """A shortened scenario stays one that a robot takes."""
    changed = scenario(tasks=40, alone=20).changed(seed=None, tasks=tasks, measure_all=False)
    assert changed.workload.alone == alone
