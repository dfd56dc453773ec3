"""`robot-client ros2` where there is no ROS: one clear line, and no import of rclpy by anything else."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.extras import needs

ROOT = Path(__file__).parents[2]
WITHOUT = "import sys; sys.modules['rclpy'] = None\n"


def run(code: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        [sys.executable, "-c", WITHOUT + code], capture_output=True, text=True, cwd=ROOT, timeout=30
    )


def test_without_rclpy_one_line_says_what_to_do() -> None:
    """Exit code 2, and one line that says what to source or to install."""
    done = run("import offboard.robot_client.__main__ as main; sys.exit(main.main(['ros2']))")
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert "rclpy cannot be imported" in done.stderr
    assert "source the setup.bash" in done.stderr
    assert "ros-kilted-rclpy[fastrtps]" in done.stderr


def test_without_cyclonedds_one_line_names_the_extra() -> None:
    """Exit code 2, and one line that says which extra the bridge needs."""
    done = run(
        "sys.modules['cyclonedds'] = None\n"
        "import offboard.robot_client.__main__ as main; sys.exit(main.main(['ros2', '--bridge']))"
    )
    assert done.returncode == 2
    assert done.stderr == (f"robot-client ros2: {needs('a bridge without ROS', 'dds')}\n")


@pytest.mark.parametrize(
    ("flags", "line"),
    [
        (["--cloud", "localhost"], "--cloud: 'localhost' is not tcp://HOST:PORT"),
        (["--policy", "papre"], "--policy: 'papre'"),
        (["--windows", "5"], "did you mean --window?"),
        (["--memory", "x", "--trace", "x"], "--memory: x is also the file of --trace"),
    ],
)
def test_wrong_flags_are_named(flags: list[str], line: str) -> None:
    """Mistakes in the flags are found before ROS is looked for."""
    done = run(f"import offboard.robot_client.__main__ as main; sys.exit(main.main(['ros2', *{flags!r}]))")
    assert done.returncode == 2
    assert line in done.stderr


def test_nothing_else_imports_rclpy() -> None:
    """`import offboard` loads nothing of ROS 2, and `offboard.ros2` works without rclpy."""
    done = run(
        "import offboard, offboard.robot_client.offloader\n"
        "assert not [name for name in sys.modules if 'ros2' in name]\n"
        "from offboard.ros2 import image_array, path_message\n"
        "import offboard.ros2.planner_server"
    )
    assert done.returncode == 0, done.stderr
