"""The time to start, the memory and CPU at rest, and the installed size."""

import contextlib
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import zmq

from benchmarks.measure import Requirement, Table, interleaved
from benchmarks.servers import READY_S, Server, cloud_server, running
from offboard.common.wire import messages as wire

COMMANDS = {"robot-client check": "robot_client check", "cloud-server": "cloud_server", "loadgen": "loadgen"}
ROBOTS = 500  # connected and idle
REST_S = 10.0
HEAVY = ("zmq", "numba")
NOTHING = "python -c pass"
ROOT = Path(__file__).parents[1]
TICK_S = 1 / os.sysconf("SC_CLK_TCK")
# A robot that is connected and idle, with its planner compiled.
ROBOT = """
import sys
from offboard import Offloader
from offboard.common.planning import planner
planner.warm()
with Offloader.connect(sys.argv[1], policy="hedge:probe:greedy") as offload:
    offload.wait_for_sites(planner.plan_path, 30.0)
    print("ready", flush=True)
    sys.stdin.read()
"""


def tables() -> list[Table]:
    return [_help(), _rest(), _installed()]


def _help() -> Table:
    python = [sys.executable]
    cases: dict[str, Callable[[], object]] = {NOTHING: lambda: _run([*python, "-c", "pass"])}
    for name, words in COMMANDS.items():
        cases[f"{name} --help"] = lambda words=words: _run(
            [*python, "-m", *f"offboard.{words}".split(), "--help"]
        )
    seconds = interleaved(cases)
    least = seconds[NOTHING]
    rows = [[name, f"{each * 1e3:.0f}", f"{each / least:.1f}"] for name, each in seconds.items()]
    requirements = [
        Requirement(f"{name}, relative to {NOTHING}", each / least, 6.0)
        for name, each in seconds.items()
        if each != least
    ]
    for name, words in COMMANDS.items():
        said = _run([*python, "-X", "importtime", "-m", *f"offboard.{words}".split(), "--help"])
        loaded = [heavy for heavy in HEAVY if f"| {heavy}\n" in said.replace(" " * 2, "")]
        requirements.append(Requirement(f"heavy libraries that {name} --help imports", len(loaded), 0))
    return Table("Time of --help", ("command", "ms", f"relative to {NOTHING}"), rows, requirements)


def _run(command: list[str]) -> str:
    return subprocess.run(command, capture_output=True, text=True, check=True).stderr


def _rest() -> Table:
    with contextlib.ExitStack() as stack:
        cache = stack.enter_context(tempfile.TemporaryDirectory())
        with cloud_server("offboard.common.planning.planner", NUMBA_CACHE_DIR=cache) as cold:
            pass
        server = stack.enter_context(cloud_server("offboard.common.planning.planner", NUMBA_CACHE_DIR=cache))
        robot = stack.enter_context(running([sys.executable, "-c", ROBOT, server.endpoint]))
        assert robot.stdout is not None
        robot.stdout.readline()
        mib = {"robot": _mib(robot.pid), "server": _mib(server.pid)}
        busy = _cpu_share({"robot": robot.pid, "server": server.pid})
        each_kb = _connected(stack, server)
    rows = [
        ["server, cold start until ready", f"{cold.took_s:.2f} s"],
        ["server, warm start (planner compiled before)", f"{server.took_s:.2f} s"],
        *([f"{name} at rest", f"{mib[name]:.0f} MiB, {busy[name]:.2%} of a core"] for name in mib),
        [f"server, per robot ({ROBOTS} are connected)", f"{each_kb:.1f} kB"],
    ]
    requirements = [
        Requirement("cold start", cold.took_s, 15.0, "s"),
        Requirement("warm start", server.took_s, 3.0, "s"),
        Requirement("robot at rest, planner compiled", mib["robot"], 200, "MiB"),
        *(Requirement(f"CPU of the {name} at rest", 100 * share, 0.5, "%") for name, share in busy.items()),
        Requirement("server memory per robot", each_kb, 50, "kB"),
    ]
    return Table("Start and rest", ("process", "time, or memory and CPU"), rows, requirements)


def _mib(pid: int) -> float:
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS")) / 1024


def _cpu_share(pids: dict[str, int]) -> dict[str, float]:
    before = {name: _ticks(pid) for name, pid in pids.items()}
    time.sleep(REST_S)
    return {name: (_ticks(pid) - before[name]) * TICK_S / REST_S for name, pid in pids.items()}


def _ticks(pid: int) -> int:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return int(fields[11]) + int(fields[12])


def _connected(stack: contextlib.ExitStack, server: Server) -> float:
    """The memory of the server for each robot that has said hello, in kB."""
    context = stack.enter_context(zmq.Context())
    context.set(zmq.MAX_SOCKETS, 2 * ROBOTS)
    before, hello = _mib(server.pid), wire.pack(wire.Hello({}, "bench", 2**20))
    for _ in range(ROBOTS):
        socket = stack.enter_context(context.socket(zmq.DEALER))
        socket.linger = 0
        socket.connect(server.endpoint)
        socket.send_multipart(hello)
        if not socket.poll(READY_S * 1e3):
            raise RuntimeError("the server did not answer hello")
    return (_mib(server.pid) - before) * 1024 * 1.024 / ROBOTS


def _installed() -> Table:
    """The size of the package with its dependencies, as pip installs them into an empty folder."""
    rows, requirements = [], []
    for what, extra, limit in (("base", "", 110), ("with planning", "[planning]", 330)):
        with tempfile.TemporaryDirectory() as folder:
            pip = [sys.executable, "-m", "pip", "install", "--quiet", "--target", folder]
            subprocess.run([*pip, f"{ROOT}{extra}"], check=True, capture_output=True)
            mb = sum(file.stat().st_size for file in Path(folder).rglob("*") if file.is_file()) / 1e6
        rows.append([what, f"{mb:.0f}"])
        requirements.append(Requirement(f"installed, {what}", mb, limit, "MB"))
    return Table("Installed size", ("package", "MB"), rows, requirements)
