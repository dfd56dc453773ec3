"""Offboard installs without a compiler: each locked dependency has a wheel for each CPU and Python."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [pytest.mark.integration, pytest.mark.timeout(180)]

ROOT = Path(__file__).parents[2]
PYTHONS = ("3.10", "3.11", "3.12", "3.13", "3.14")
CPUS = ("aarch64", "x86_64")
LOCKS = ("robot", "cloud", "bench")
UNREACHABLE = "error sending request"  # what uv says if no index answers


def installed(folder: Path, python: str, cpu: str, *wanted: str) -> str:
    """What uv would install, from wheels alone; the test is skipped if it reaches no package index."""
    command = [sys.executable, "-m", "uv", "--no-progress", "--color", "never", "pip", "install", "--dry-run"]
    command += ["--only-binary", ":all:", "--python-platform", f"{cpu}-manylinux_2_28"]
    command += ["--python-version", python, "--target", str(folder), *wanted]
    environ = os.environ | {"UV_HTTP_RETRIES": "1"}
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=environ, timeout=150)
    if done.returncode and UNREACHABLE in done.stderr:
        pytest.skip(f"uv reaches no package index: {done.stderr.strip().splitlines()[-1]}")
    assert done.returncode == 0, done.stderr
    return done.stderr


@pytest.mark.parametrize("lock", LOCKS)
@pytest.mark.parametrize("cpu", CPUS)
@pytest.mark.parametrize("python", PYTHONS)
def test_every_locked_dependency_has_a_wheel(python: str, cpu: str, lock: str, tmp_path: Path) -> None:
    """The wheels have the hashes of the lock; numpy is one of them."""
    found = installed(
        tmp_path, python, cpu, "--no-deps", "--require-hashes", "-r", f"requirements/{lock}.txt"
    )
    assert " + numpy==" in found


@pytest.mark.parametrize("python", PYTHONS)
def test_the_newest_dependencies_of_a_robot_have_wheels_for_arm(python: str, tmp_path: Path) -> None:
    """`pip install offboard` on a robot takes what the index has now, not what the lock says."""
    assert " + pyzmq==" in installed(tmp_path, python, "aarch64", "-r", "pyproject.toml")
