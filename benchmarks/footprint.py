"""The time to start, the memory and CPU at rest, and the installed size."""

import contextlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import zmq

from benchmarks.measure import Requirement, Table, interleaved
from benchmarks.servers import READY_S, Server, cloud_server, running
from offboard.common.wire import messages as wire
from offboard.robot_client.sites.heartbeat import EVERY_S, IDLE_S

COMMANDS = {"robot-client check": "robot_client check", "cloud-server": "cloud_server", "loadgen": "loadgen"}
ROBOTS = 1_000  # connected
BEATS_A_S = {"with tasks": 1 / EVERY_S, "without tasks": 1 / IDLE_S}  # of each robot
REST_S = 10.0
CPUCLOCK_SCHED = 2
HEAVY = ("zmq", "numba")
NOTHING, IMPORT = "python -c pass", "import offboard"
ROOT = Path(__file__).parents[1]
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
    cases[IMPORT] = lambda: _run([*python, "-c", IMPORT])
    seconds = interleaved(cases)
    least = seconds[NOTHING]
    rows = [[name, f"{each * 1e3:.0f}", f"{each / least:.1f}"] for name, each in seconds.items()]
    requirements = [
        Requirement(f"{name}, relative to {NOTHING}", each / least, 6.0)
        for name, each in seconds.items()
        if each != least
    ]
    requirements.append(Requirement(f"{IMPORT} alone", (seconds[IMPORT] - least) * 1e3, 60, "ms"))
    for name, words in COMMANDS.items():
        said = _run([*python, "-X", "importtime", "-m", *f"offboard.{words}".split(), "--help"])
        loaded = [heavy for heavy in HEAVY if f"| {heavy}\n" in said.replace(" " * 2, "")]
        requirements.append(Requirement(f"heavy libraries that {name} --help imports", len(loaded), 0))
    return Table(
        "Time of --help and of an import", ("command", "ms", f"relative to {NOTHING}"), rows, requirements
    )


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
        before = _mib(server.pid)
        sockets = _connected(stack, server)
        each_kb = (_mib(server.pid) - before) * 1024 * 1.024 / ROBOTS
        beating = {
            name: _cpu_share({"server": server.pid}, meanwhile=partial(_beat, sockets, each))["server"]
            for name, each in BEATS_A_S.items()
        }
    rows = [
        ["server, cold start until ready", f"{cold.took_s:.2f} s"],
        ["server, warm start (planner compiled before)", f"{server.took_s:.2f} s"],
        *([f"{name} at rest", f"{mib[name]:.0f} MiB, {busy[name]:.2%} of a core"] for name in mib),
        [f"server, per robot ({ROBOTS} are connected)", f"{each_kb:.1f} kB"],
        *(
            [
                f"server, heartbeats of {ROBOTS} robots {name}, {BEATS_A_S[name]:g} a second each",
                f"{share:.1%} of a core",
            ]
            for name, share in beating.items()
        ),
    ]
    requirements = [
        Requirement("cold start", cold.took_s, 15.0, "s"),
        Requirement("warm start", server.took_s, 3.0, "s"),
        Requirement("robot at rest, planner compiled", mib["robot"], 200, "MiB"),
        *(Requirement(f"CPU of the {name} at rest", 100 * share, 0.5, "%") for name, share in busy.items()),
        Requirement("server memory per robot", each_kb, 50, "kB"),
        Requirement(
            f"CPU of the server for the heartbeats of {ROBOTS} robots without tasks",
            100 * beating["without tasks"],
            10,
            "%",
        ),
    ]
    return Table("Start and rest", ("process", "time, or memory and CPU"), rows, requirements)


def _mib(pid: int) -> float:
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS")) / 1024


def _cpu_share(
    pids: dict[str, int], meanwhile: Callable[[], object] = lambda: time.sleep(REST_S)
) -> dict[str, float]:
    before, began_s = {name: _cpu_s(pid) for name, pid in pids.items()}, time.perf_counter()
    meanwhile()
    took_s = time.perf_counter() - began_s
    return {name: (_cpu_s(pid) - before[name]) / took_s for name, pid in pids.items()}


def _cpu_s(pid: int) -> float:
    """The CPU time of all threads of a process, ended ones too. `/proc` counts it in steps of 10 ms only."""
    return time.clock_gettime(~pid << 3 | CPUCLOCK_SCHED)  # as clock_getcpuclockid(3) makes it


def _connected(stack: contextlib.ExitStack, server: Server) -> "list[zmq.Socket[bytes]]":
    """The sockets of robots that have said hello."""
    context = stack.enter_context(zmq.Context())
    context.set(zmq.MAX_SOCKETS, 2 * ROBOTS)
    sockets, hello = list[zmq.Socket[bytes]](), wire.pack(wire.Hello({}, "bench", 2**20))
    for _ in range(ROBOTS):
        socket = stack.enter_context(context.socket(zmq.DEALER))
        socket.linger = 0
        socket.connect(server.endpoint)
        socket.send_multipart(hello)
        if not socket.poll(READY_S * 1e3):
            raise RuntimeError("the server did not answer hello")
        socket.recv_multipart()
        sockets.append(socket)
    return sockets


def _beat(sockets: "list[zmq.Socket[bytes]]", each_a_s: float) -> None:
    """Send the heartbeats of all robots, evenly spread over the time, and read the answers."""
    began_s, ping = time.perf_counter(), wire.pack(wire.Ping(1))
    for n in range(int(REST_S * each_a_s * len(sockets))):
        time.sleep(max(0.0, began_s + n / (each_a_s * len(sockets)) - time.perf_counter()))
        socket = sockets[n % len(sockets)]
        if n >= len(sockets):
            if not socket.poll(READY_S * 1e3):
                raise RuntimeError("the server did not answer a heartbeat")
            socket.recv_multipart()
        socket.send_multipart(ping)


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
