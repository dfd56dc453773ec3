"""A process without a free file or thread gets one clear error, and never ends because of it."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytestmark = [pytest.mark.integration, pytest.mark.timeout(120)]

ROOT = Path(__file__).parents[2]


def play(*args: str) -> Any:
    command = [sys.executable, "-m", "tests.scarce", *args]
    done = subprocess.run(command, capture_output=True, text=True, timeout=110, cwd=ROOT)
    assert done.returncode == 0, f"exit code {done.returncode}: {done.stderr}"
    return json.loads(done.stdout)


@pytest.mark.parametrize("scarce", ["files", "threads"])
@pytest.mark.parametrize("what", ["connect", "serve"])
def test_without_files_or_threads_there_is_one_clear_error(what: str, scarce: str) -> None:
    """With few of them left, the error says how many are needed; with enough, it works.

    libzmq itself would end the process.
    """
    outcomes = play(what, scarce)
    failed = [one for one in outcomes if one != "made"]
    assert (outcomes[0], outcomes[-1]) == (failed[0], "made")
    where = {"connect": "cloud: endpoint 'tcp://127.0.0.1:9'", "serve": "--listen: 'tcp://127.0.0.1:*'"}[what]
    for one in failed:
        assert one.startswith(f"{where}: a connection needs ")
        assert f" {scarce}, and this process may " in one


def test_a_robot_without_files_connects_again_later() -> None:
    """While no file is left, tasks run onboard; once there are files, the server is used again."""
    assert play("reconnect") == "used again"


def test_a_large_argument_is_sent_without_a_free_file() -> None:
    """What pyzmq needs for messages that it does not copy is there before the first of them."""
    assert play("large") == "cloud"
