"""A robot with an ARM processor installs Offboard without a compiler: each dependency has a wheel for it."""

import subprocess
import sys
import tomllib
from collections.abc import Sequence
from pathlib import Path

import pytest

pytestmark = [pytest.mark.integration, pytest.mark.timeout(600)]

ROOT = Path(__file__).parents[2]
PLATFORMS = ("manylinux_2_28_aarch64", "manylinux2014_aarch64")
DEPENDENCIES = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
UNREACHABLE = "after connection broken by"  # what pip says before it tries again
LOCK = ("--require-hashes", "--requirement", str(ROOT / "requirements" / "robot.txt"))


@pytest.mark.parametrize("wanted", [DEPENDENCIES, LOCK], ids=["dependencies", "lock"])
def test_every_dependency_has_a_wheel_for_arm(wanted: Sequence[str], tmp_path: Path) -> None:
    """pip finds wheels of all of them, and of what they need, for this version of Python."""
    command = [sys.executable, "-m", "pip", "download", "--only-binary=:all:", "--retries", "1"]
    for platform in PLATFORMS:
        command += ["--platform", platform]
    command += ["--dest", str(tmp_path), *wanted]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    unreachable = [line for line in done.stderr.splitlines() if UNREACHABLE in line]
    if unreachable and done.returncode:
        pytest.skip(f"pip reaches no package index: {unreachable[0]}")
    assert done.returncode == 0, done.stderr
    found = sorted(path.name for path in tmp_path.glob("*.whl"))
    print("\n".join(found))
    assert {"numpy", "msgpack", "pyzmq", "prometheus_client"} <= {name.split("-")[0] for name in found}
    assert all(name.endswith(("aarch64.whl", "-none-any.whl")) for name in found)
