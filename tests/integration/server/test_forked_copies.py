"""A task that forks and does not end the child leaves no copy of the server, or of its worker, behind."""

import contextlib
import os
import signal
from pathlib import Path

import pytest

from tests.executor_tasks import ON_THIS_COMPUTER
from tests.integration.server.peers import Command, Join, until

pytestmark = pytest.mark.integration

HOW = ("returns", "raises", "exits")


def ended(pid: int) -> bool:
    """Whether a process has ended; nobody may have asked for its exit code yet."""
    try:
        return (Path("/proc") / str(pid) / "stat").read_text().rpartition(") ")[2].startswith("Z")
    except OSError:
        return True


def kill(pid: int) -> None:
    with contextlib.suppress(OSError):
        os.kill(pid, signal.SIGKILL)


@pytest.mark.parametrize("how", HOW)
@pytest.mark.parametrize("executor", ON_THIS_COMPUTER)
def test_a_copy_ends_by_itself(folder: Path, join: Join, executor: str, how: str) -> None:
    """However the task ends in it. The server answers once, answers the next task, and stops as ever."""
    command = Command(folder, "--executor", executor)
    with command.process as process, contextlib.ExitStack() as stack:
        stack.callback(process.kill)
        peer = join(command.endpoint)
        for number in range(1, 4):
            copy = peer.value(number, "served_fork", how)
            stack.callback(kill, copy)
            until(lambda: ended(copy))  # noqa: B023
        assert peer.value(4, "served_count") == 0
        code, text = command.end(signal.SIGTERM)
        assert code == 0, text
        assert ("ValueError: raises" in text) == (how == "raises")
