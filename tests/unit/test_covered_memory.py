"""What a memory file recalls of a task that covers a file, such as its model."""

import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from offboard.common.source.comparison import read_files_of_robot
from offboard.common.source.covers import CoveredFiles
from offboard.common.tasks import kind_of, task
from offboard.robot_client.sites.runner import CLOUD
from tests.memory_robot import Robot

Covering = Callable[[float], float]
TASKS = 20


def covering(model: Path) -> Covering:
    """The task as the next process registers it."""

    def covered(size: float) -> float:
        return size

    task("store_covering", size=lambda size: size, covers=(model,))(covered)
    return covered


@pytest.fixture
def robot(tmp_path: Path) -> Robot:
    return Robot(tmp_path)


@pytest.fixture
def model(tmp_path: Path, robot: Robot) -> Path:
    """The model of a task that the robot has learnt."""
    model = tmp_path / "model.bin"
    model.write_bytes(b"weights")
    function = covering(model)
    with robot.started() as offload:
        read_files_of_robot(kind_of(function))
        robot.ask(offload, TASKS, function)
    return model


def known(robot: Robot, function: Covering) -> int:
    with robot.started() as offload:
        read_files_of_robot(kind_of(function))
        return robot.outlooks(offload, function)[CLOUD].observations


def test_the_same_file_is_recalled(robot: Robot, model: Path) -> None:
    """A restart with the same model knows what the robot knew."""
    assert known(robot, covering(model)) == TASKS


def test_a_changed_file_starts_cold(robot: Robot, model: Path) -> None:
    """Another model may take another time."""
    model.write_bytes(b"other")
    assert known(robot, covering(model)) == 0


def test_nothing_is_lost_while_a_file_is_read(
    robot: Robot, model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Calls do not wait for it; what the file of the memory holds is recalled once the model is read."""
    go_on, digest = threading.Event(), CoveredFiles._digest
    monkeypatch.setattr(CoveredFiles, "_digest", lambda *given: (go_on.wait(), digest(*given))[1])
    slow = covering(model)
    with robot.started() as offload:
        robot.ask(offload, 1, slow)
        assert robot.outlooks(offload, slow)[CLOUD].observations == 1
    with robot.started() as offload:
        robot.ask(offload, 1, slow)
        go_on.set()
        read_files_of_robot(kind_of(slow))
        assert robot.outlooks(offload, slow)[CLOUD].observations == TASKS + 1
