"""What the processes take at rest and until they are ready, and what is installed for them."""

import contextlib
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import zmq

from benchmarks.measure import Bar, Table, interleaved
from benchmarks.servers import READY_S, Server, cloud_server, running
from offboard.common.wire import messages as wire

COMMANDS = {"robot-client": "robot_client", "cloud-server": "cloud_server", "loadgen": "loadgen"}
ROBOTS = 500  # that are connected and idle
REST_S = 10.0
HEAVY = ("zmq", "numba")
ROOT = Path(__file__).parents[1]
TICK_S = 1 / os.sysconf("SC_CLK_TCK")
# A robot that has planned once, and now waits.
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
    cases: dict[str, Callable[[], object]] = {"python -c pass": lambda: _run([*python, "-c", "pass"])}
    for name, package in COMMANDS.items():
        cases[f"{name} --help"] = lambda package=package: _run(
            [*python, "-m", f"offboard.{package}", "--help"]
        )
    seconds = interleaved(cases)
    least = seconds["python -c pass"]
    rows = [[name, f"{each * 1e3:.0f}", f"{each / least:.1f}"] for name, each in seconds.items()]
    bars = [Bar(f"{name} over nothing", each / least, 6.0) for name, each in seconds.items() if each != least]
    for name, package in COMMANDS.items():
        said = _run([*python, "-X", "importtime", "-m", f"offboard.{package}", "--help"])
        loaded = [heavy for heavy in HEAVY if f"| {heavy}\n" in said.replace(" " * 2, "")]
        bars.append(Bar(f"heavy libraries that {name} --help loads", len(loaded), 0))
    return Table("--help", ("command", "ms", "over nothing"), rows, bars)


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
        ["server, from nothing to ready", f"{cold.took_s:.2f} s"],
        ["server, its planner compiled before", f"{server.took_s:.2f} s"],
        *([f"{name} at rest", f"{mib[name]:.0f} MiB, {busy[name]:.2%} of a core"] for name in mib),
        [f"server, for each of {ROBOTS} connected robots", f"{each_kb:.1f} kB"],
    ]
    bars = [
        Bar("cold start", cold.took_s, 15.0, " s"),
        Bar("warm start", server.took_s, 3.0, " s"),
        Bar("robot at rest, planner compiled", mib["robot"], 200, " MiB"),
        *(Bar(f"CPU of the {name} at rest", 100 * share, 0.5, " %") for name, share in busy.items()),
        Bar("server memory a robot", each_kb, 50, " kB"),
    ]
    return Table("At rest", ("what", "takes"), rows, bars)


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
    """kB that the server takes more for each robot that has said hello."""
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
    """As pip installs the package and what it needs into an empty folder."""
    rows, bars = [], []
    for what, extra, limit in (("base", "", 110), ("with planning", "[planning]", 330)):
        with tempfile.TemporaryDirectory() as folder:
            command = [
                sys.executable,
                "-m",
                "pip",
                "install",
                "--quiet",
                "--target",
                folder,
                f"{ROOT}{extra}",
            ]
            subprocess.run(command, check=True, capture_output=True)
            mb = sum(file.stat().st_size for file in Path(folder).rglob("*") if file.is_file()) / 1e6
        rows.append([what, f"{mb:.0f}"])
        bars.append(Bar(f"installed, {what}", mb, limit, " MB"))
    return Table("Installed", ("what", "MB"), rows, bars)
