"""Namespaces of our own, in which a script may cut cables and change names, and why there are none here."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
UNSHARE = ["unshare", "--user", "--map-root-user", "--net", "--mount"]
TRIAL = """
    ip link add robot type veth peer name server
    ip link set lo up
    ip -6 address add fd77::7/128 dev lo
"""


def run_alone(module: str, *args: str, timeout_s: float) -> Any:
    """Run a module in its own network and mount namespaces as root; returns the JSON that it prints.

    Skips the test if such namespaces cannot be created.
    """
    try:
        trial = subprocess.run([*UNSHARE, "sh", "-ec", TRIAL], capture_output=True, text=True, timeout=10)
        failed = trial.stderr.strip() if trial.returncode else ""
    except OSError as error:
        failed = str(error)
    if failed:
        pytest.skip(f"no network namespaces can be created here: {failed}")
    command = [*UNSHARE, sys.executable, "-m", module, *args]
    done = subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)
