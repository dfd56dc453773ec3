"""The types that a user's type checker sees."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = ("common", "robot_client")


@pytest.mark.timeout(240)  # mypy reads numpy and the library, once; later runs use its cache
def test_a_call_has_the_type_of_its_task(tmp_path: Path) -> None:
    """A call, a batch and a coroutine return what the function returns, also for a task with a setup."""
    (tmp_path / "offboard").mkdir()
    for file in ("__init__.py", "py.typed"):
        shutil.copy(ROOT / "offboard" / file, tmp_path / "offboard")
    for package in PACKAGES:  # as in the wheel
        (tmp_path / "offboard" / package).symlink_to(ROOT / package)
    done = subprocess.run(
        [
            sys.executable,
            *("-m", "mypy", "--strict", "--follow-imports=silent"),
            *("--config-file", ROOT / "pyproject.toml", "--cache-dir", ROOT / ".cache/mypy-calls"),
            ROOT / "tests/typed_calls.py",
        ],
        capture_output=True,
        text=True,
        timeout=200,
        cwd=tmp_path,
        env=os.environ | {"MYPYPATH": str(tmp_path)},
    )
    assert done.returncode == 0, done.stdout + done.stderr
