"""A node ends with exit code 0 whenever the signal comes."""

import os
import subprocess

import pytest

from tests.ros2.conftest import RELEASES, ROOT, python_of

pytestmark = pytest.mark.ros2


@pytest.mark.parametrize("release", RELEASES)
def test_a_context_that_ends_within_a_step_of_spin_is_a_clean_end(release: str) -> None:
    """rclpy's RCLError of a context that has ended is no error; another error passes."""
    python = python_of(release)
    command = [str(python), "-m", "tests.ros2.shutdown_node"]
    environ = os.environ | {"NUMBA_CACHE_DIR": str(python.parents[1] / "numba")}
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, timeout=50, cwd=ROOT, env=environ
    )
    assert (done.returncode, done.stdout) == (0, "a defect\nended\n"), done.stderr
