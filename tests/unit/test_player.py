"""The start of a run: flags that the parts accept, a clean folder, and the files of each robot."""

from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest

from offboard.cloud_server.config import ServerConfig
from offboard.cloud_server.executors import EXECUTORS
from offboard.common.command_line import load
from offboard.common.errors import ConfigError
from offboard.common.toml_file import read_toml
from offboard.loadgen.play.part_setups import setups
from offboard.loadgen.play.run_files import LineCounter, RobotFiles, clear_folder
from offboard.loadgen.relay.link.link_settings import as_flags
from offboard.loadgen.relay.wan import WanConfig
from offboard.loadgen.robot.config import CallConfig, DriveConfig
from offboard.loadgen.robot_files import alone_path, reference_path
from offboard.loadgen.scenario.scenario import CloudPart, Scenario, Workload
from offboard.loadgen.scenario.scenario_file import find_scenario, read_scenario, shipped
from offboard.loadgen.testbed.testbed import CLOUD, ROBOT, WAN, kind_of
from tests.executor_tasks import ON_THIS_COMPUTER

CONFIGS = {CLOUD: ServerConfig, WAN: WanConfig, "drive": DriveConfig, "call": CallConfig}


def scenario(**workload: Any) -> Scenario:
    return Scenario("small", 7, Workload(map=Path("m.yaml"), **workload))


@pytest.mark.parametrize("name", shipped())
def test_the_parts_accept_every_flag_of_a_scenario(name: str, tmp_path: Path) -> None:
    """Every part accepts all of its flags, and they carry the values of the scenario."""
    read = read_scenario(find_scenario(name))
    made = setups(read, tmp_path)
    configs = {
        part: load(
            CONFIGS[setup.command or kind_of(part)],
            [*as_flags(setup.flags), *(["--cloud=tcp://wan:5555"] if kind_of(part) == ROBOT else [])],
            prog="",
            description="",
            environ={},
            prefix="X",
        )
        for part, setup in made.items()
    }
    robot, wan = configs[ROBOT], configs[WAN]
    assert isinstance(robot, DriveConfig | CallConfig)
    assert isinstance(wan, WanConfig)
    assert (robot.tasks, robot.seed, robot.alone) == (read.workload.tasks, read.seed, read.workload.alone)
    assert robot.sizes == read.workload.sizes
    if isinstance(robot, DriveConfig):
        assert (robot.map, robot.resolution) == (read.workload.map, 0.025)
    assert (robot.trace, robot.answers) == (tmp_path / "trace.jsonl", tmp_path / "answers.jsonl")
    assert (wan.delay_ms, wan.seed) == (read.links()[CLOUD].get("delay_ms", WanConfig.delay_ms), read.seed)
    assert len(configs) == 2 * len(read.servers) + read.workload.robots


def test_every_key_of_a_shipped_scenario_is_read() -> None:
    """Every key in a shipped scenario is a field of `Scenario`, so that none is silently ignored."""
    known = {"event", "check", "cloud", *(field.name for field in fields(Scenario))}
    for name in shipped():
        assert read_toml(find_scenario(name)).keys() <= known


def test_every_robot_gets_the_planner_of_the_scenario(tmp_path: Path) -> None:
    """Every robot searches with the planner of the workload."""
    made = setups(scenario(robots=2, planner="jps"), tmp_path)
    assert [setup.flags["planner"] for part, setup in made.items() if part.startswith(ROBOT)] == ["jps"] * 2


@pytest.mark.parametrize("heartbeats", [None, True, False])
def test_every_robot_gets_the_heartbeats_of_the_scenario(tmp_path: Path, heartbeats: bool | None) -> None:
    """Without `robot.heartbeats`, the policy of the robots decides."""
    made = setups(scenario(robots=2).changed(heartbeats=heartbeats), tmp_path)
    for part, setup in made.items():
        if part.startswith(ROBOT):
            flags = [*as_flags(setup.flags), "--cloud=tcp://wan:5555"]
            robot = load(DriveConfig, flags, prog="", description="", environ={}, prefix="X")
            assert robot.heartbeats == heartbeats


def test_every_robot_has_its_own_files_and_seed(tmp_path: Path) -> None:
    """Robots have different files and seeds; the file names of the first robot have no number."""
    files = list(RobotFiles.of(scenario(robots=3), tmp_path))
    assert [one.trace.name for one in files] == ["trace.jsonl", "trace-2.jsonl", "trace-3.jsonl"]
    assert [one.answers.name for one in files] == ["answers.jsonl", "answers-2.jsonl", "answers-3.jsonl"]
    assert files[0].seed == 7
    assert len({one.seed for one in files}) == 3


def test_the_files_of_an_earlier_run_are_removed(tmp_path: Path) -> None:
    """All files that a run may write are removed, and other files stay."""
    out = tmp_path / "new" / "out"
    clear_folder(out)
    trace = out / "trace.jsonl"
    for path in (trace, alone_path(trace), reference_path(trace), out / "answers-2.jsonl", out / "table.md"):
        path.write_text("old")
    clear_folder(out)
    assert [path.name for path in out.iterdir()] == ["table.md"]


@pytest.mark.parametrize(("tasks", "alone"), [(None, 20), (50, 20), (6, 6)])
def test_fewer_tasks_limit_the_extra_plans(tasks: int | None, alone: int) -> None:
    """A shortened scenario has at most as many extra plans (`alone`) as tasks; a robot refuses more."""
    changed = scenario(tasks=40, alone=20).changed(seed=None, tasks=tasks, measure_all=False)
    assert changed.workload.alone == alone


def test_only_whole_lines_are_counted(tmp_path: Path) -> None:
    """A half-written line counts once it is finished; an absent file has no lines."""
    lines = LineCounter(tmp_path / "a")
    assert lines.count() == 0
    with (tmp_path / "a").open("w", buffering=1) as file:
        file.write("one\ntwo\nthr")
        file.flush()
        assert lines.count() == 2
        file.write("ee\n")
        assert lines.count() == 3


def test_server_and_scenario_know_the_same_executors() -> None:
    """A server can be started with each registered executor, a scenario with those on one computer."""
    for name in EXECUTORS:
        assert ServerConfig(executor=name).executor == name
    for name in ON_THIS_COMPUTER:
        assert CloudPart(executor=name).executor == name
    with pytest.raises(ConfigError, match=f"is not one of {', '.join(EXECUTORS)}"):
        ServerConfig(executor="fibres")
    with pytest.raises(ConfigError, match="is not one of threads, processes"):
        CloudPart(executor="ray")
