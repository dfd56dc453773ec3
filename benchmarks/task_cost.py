"""The instructions of the processor that an empty remote task takes, on the robot and on the server.

Callgrind counts those of the program and its libraries, not those of the kernel. Counts hardly depend on
what else the machine does.
"""

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from benchmarks.measure import Table
from benchmarks.servers import READY_S, free_port
from benchmarks.tasks import nothing
from offboard.cloud_server import __main__ as cloud_server
from offboard.cloud_server import reader_threads
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.sites.runner import CLOUD

WARM, COUNT = 100, 1_000  # tasks before counting begins, and tasks that are counted
SLOWER = 4  # times as long as usual may the start of a process take
COLLECTED = re.compile(r"Collected : (\d+)")
ROBOT, SERVER = "robot", "server"


def tables() -> list[Table]:
    columns = ("side", "instructions of an empty remote task")
    title = "The cost of a remote task"
    missing = why_not()
    if missing is not None:
        return [Table(title, columns, [], missing=[missing])]
    rows = [[side, f"{instructions(side):,.0f}"] for side in (ROBOT, SERVER)]
    return [Table(title, columns, rows)]


def why_not() -> str | None:
    """Why nothing can be counted here; None if it can."""
    lacks = [one for one in ("valgrind", "callgrind_control") if shutil.which(one) is None]
    return f"{' and '.join(lacks)} not installed" if lacks else None


def instructions(side: str) -> float:
    """The instructions of one task on this side. The other side runs as usual."""
    endpoint = f"tcp://127.0.0.1:{free_port()}"
    with (
        _process(SERVER, endpoint, counted=side == SERVER) as server,
        _process(ROBOT, endpoint, counted=side == ROBOT) as robot,
    ):
        _say(robot, WARM)
        counted = robot if side == ROBOT else server
        subprocess.run(["callgrind_control", "--instr=on", str(counted.pid)], check=True, capture_output=True)
        _say(robot, COUNT)
        subprocess.run(
            ["callgrind_control", "--instr=off", str(counted.pid)], check=True, capture_output=True
        )
        robot.communicate(timeout=SLOWER * READY_S)
        server.send_signal(signal.SIGTERM)
        said = server.communicate(timeout=SLOWER * READY_S)[1]
    return said


@contextlib.contextmanager
def _process(side: str, endpoint: str, *, counted: bool) -> Iterator["subprocess.Popen[str]"]:
    pass
