"""The instructions of the processor that an empty remote task takes, on the robot and on the server.

Callgrind counts those of the program and its libraries, not those of the kernel. Work that depends on the
clock is left out, so that two counts differ by less than 1 %. Builds of Python differ more, so each count is
also shown relative to a fixed piece of Python.
"""

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from benchmarks.measure import Requirement, Table
from benchmarks.servers import free_port
from benchmarks.tasks import nothing
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.sites.runner import CLOUD

ROBOT, SERVER = SIDES = "robot", "server"
REFERENCE = "a fixed piece of Python"
WARM, COUNT = 100, 500  # tasks before counting begins, and tasks that are counted
WAIT_S = 120.0  # for a process that Callgrind slows down
NEVER_S = 3600.0
COLLECTED = re.compile(r"Collected : (\d+)")


def tables() -> list[Table]:
    title = "The cost of an empty remote task"
    columns = ("side", "instructions", f"relative to {REFERENCE}")
    why = why_not()
    if why is not None:
        return [Table(title, columns, [], missing=[why])]
    reference, found = of_reference(), {side: instructions(side) for side in SIDES}
    return [Table(title, columns, [[side, f"{n:,.0f}", f"{n / reference:.2f}"] for side, n in found.items()])]


def why_not() -> str | None:
    """Why nothing can be counted here; None if it can."""
    lacks = [one for one in ("valgrind", "callgrind_control") if shutil.which(one) is None]
    return f"{lacks[0]} is not installed" if lacks else None


def instructions(side: str) -> float:
    """The instructions of one task on this side. The other side runs as usual."""
    endpoint = f"tcp://127.0.0.1:{free_port()}"
    with _running(SERVER, endpoint, counted=side == SERVER) as (server, of_server):
        with _running(ROBOT, endpoint, counted=side == ROBOT) as (robot, of_robot):
            _count(robot, robot if side == ROBOT else server)
        server.send_signal(signal.SIGTERM)
    return (of_robot if side == ROBOT else of_server)[0] / COUNT


def of_reference() -> float:
    """The instructions of the fixed piece of Python."""
    with _running(REFERENCE, "", counted=True) as (process, found):
        _count(process, process)
    return found[0] / COUNT


@contextlib.contextmanager
def _running(
    side: str, endpoint: str, *, counted: bool
) -> "Iterator[tuple[subprocess.Popen[str], list[int]]]":
    """A process, and a list that gets the instructions that were counted when it has ended."""
    found, environ, pipe = list[int](), os.environ | {"PYTHONHASHSEED": "0"}, subprocess.PIPE
    command = [sys.executable, "-m", __spec__.name, side, endpoint]
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "log"
        if counted:
            files = [f"--callgrind-out-file={folder}/out", f"--log-file={log}"]
            command = ["valgrind", "--tool=callgrind", "--instr-atstart=no", *files, *command]
        process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, env=environ)
        try:
            yield process, found
            process.communicate(timeout=WAIT_S)
        finally:
            process.kill()
            process.wait()
        if counted:
            collected = COLLECTED.search(log.read_text())
            assert collected is not None
            found.append(int(collected[1]))


def _count(robot: "subprocess.Popen[str]", counted: "subprocess.Popen[str]") -> None:
    """Let the robot make its tasks, and count the instructions of one of the processes meanwhile."""
    _make(robot, WARM)
    for way, count in (("on", COUNT), ("off", 0)):
        command = ["callgrind_control", f"--instr={way}", str(counted.pid)]
        subprocess.run(command, check=True, capture_output=True, timeout=WAIT_S)
        _make(robot, count)


def _make(robot: "subprocess.Popen[str]", count: int) -> None:
    assert robot.stdin is not None
    assert robot.stdout is not None
    print(count, file=robot.stdin, flush=True)
    if robot.stdout.readline() != "done\n":
        raise RuntimeError("the robot made no tasks")


def _reference(_endpoint: str) -> None:
    for line in sys.stdin:
        for _ in range(int(line)):
            costs = {str(n): Requirement("cost", float(n % 7), 3.0, at_least=bool(n % 2)) for n in range(50)}
            held = [name for name, one in costs.items() if one.holds]
            sorted(held, key=lambda name: costs[name].value)
        print("done", flush=True)


def _robot(endpoint: str) -> None:
    with Offloader.connect(endpoint, policy=CLOUD, timeout_s=WAIT_S) as offload:
        absent = offload.wait_for_sites(nothing, WAIT_S)
        if absent:
            raise RuntimeError(str(absent))
        for line in sys.stdin:
            for _ in range(int(line)):
                offload(nothing)
            assert offload.last is not None
            assert offload.last.used == CLOUD, offload.last.executions
            print("done", flush=True)


def _server(endpoint: str) -> None:
    """The server as ever, but what depends on the clock does not happen: here, time passes slowly."""
    from offboard.cloud_server import __main__, connections, reader_threads, server
    from offboard.common import load

    reader_threads.SHORT_S = reader_threads.AWAY_S = NEVER_S
    server.SERVER_EVERY_S = server.LOOK_S = connections.MEMORY_S = load.HURRIED_S = NEVER_S
    flags = ["--listen", endpoint, "--http", "127.0.0.1:0", "--tasks", "benchmarks.tasks", "--log", "error"]
    sys.argv = ["cloud-server", *flags, "--robot-mib-s", "65536"]
    sys.exit(__main__.main())


if __name__ == "__main__":
    {ROBOT: _robot, SERVER: _server, REFERENCE: _reference}[sys.argv[1]](sys.argv[2])
