"""`python -m benchmarks.capacity FILE`: measures what one server carries, and writes the figures as JSON.

Real robots (`loadgen drive`) ask a real `cloud-server` for plans at random instants, at several rates.
`cost_per_task` says what the figures mean in servers and money.
"""

import argparse
import json
import os
import re
import resource
import statistics
import subprocess
import sys
import tempfile
import time
import urllib.request
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from benchmarks.measure import processor
from benchmarks.servers import Server, cloud_server
from offboard.loadgen.play.machine import commit_here
from offboard.loadgen.robot_files import read_trace

MAP = Path(__file__).parents[1] / "maps" / "willow-full-0.05.yaml"
ROBOTS = 4  # processes that share a rate
TIMEOUT_S = 5.0  # then a robot plans onboard
STARTED_S = 120.0  # a robot may take longer than its tasks by this much
TICKS = os.sysconf("SC_CLK_TCK")
OK = re.compile(r'^offboard_server_requests_total{kind="plan_path",status="ok"} (\S+)$', re.MULTILINE)


@dataclass(frozen=True, slots=True)
class Step:
    """One rate: tasks that robots asked for and the server answered, waits of robots, and cost of a task.

    `cpu_s` is the server's for one task; `robots_cpus` and `others_cpus` are the CPUs that the robots and all
    other programs of the machine used meanwhile.
    """

    asked_a_s: float
    answered_a_s: float
    by_server: float
    p50_ms: float
    p95_ms: float
    cpu_s: float
    robots_cpus: float
    others_cpus: float
    bytes_to_server: float
    bytes_to_robot: float


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.capacity", description=__doc__)
    parser.add_argument("file", type=Path, metavar="FILE")
    parser.add_argument(
        "--rates", default="10,20,30,40,50,60", help="tasks per second (default: %(default)s)"
    )
    parser.add_argument("--seconds", type=float, default=20.0, help="of one rate (default: %(default)s)")
    parser.add_argument("--resolution", default="0.025", help="of the map, in metres (default: %(default)s)")
    parser.add_argument(
        "--workers", type=int, default=os.cpu_count(), help="of the server (default: all CPUs)"
    )
    chosen = parser.parse_args()
    steps = []
    with cloud_server(
        "offboard.common.planning.planner", CLOUD_WORKERS=str(chosen.workers), CLOUD_ROBOT_MIB_S="64"
    ) as server:
        before = memory_mib(server, "VmRSS")
        for rate in map(float, chosen.rates.split(",")):
            step = measure(server, rate, seconds=chosen.seconds, resolution=chosen.resolution)
            print(step, file=sys.stderr, flush=True)
            steps.append(asdict(step))
        figures = {
            "measured": f"{datetime.now(timezone.utc):%Y-%m-%d}, commit {commit_here() or 'unknown'}",
            "machine": f"{processor()}, {os.cpu_count()} cores, shared by server and {ROBOTS} robots",
            "task": f"plan_path on {MAP.stem} at {chosen.resolution} m",
            "workers": chosen.workers,
            "memory_idle_mib": before,
            "memory_peak_mib": memory_mib(server, "VmHWM"),
            "steps": steps,
        }
    chosen.file.write_text(json.dumps(figures, indent=1) + "\n")


def measure(server: Server, rate: float, *, seconds: float, resolution: str) -> Step:
    """Let robots ask for tasks at random instants, `rate` per second together."""
    tasks = max(2, round(rate * seconds / ROBOTS))
    plans, cpu_s, robots_s, busy_s = answered(server), cpu_seconds(server), children_s(), machine_s()
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        traces = [Path(folder) / f"{number}.jsonl" for number in range(ROBOTS)]
        robots = [
            stack.enter_context(drive(server, trace, seed, rate=rate, tasks=tasks, resolution=resolution))
            for seed, trace in enumerate(traces, 1)
        ]
        for robot in robots:
            if robot.wait(seconds + STARTED_S):
                raise RuntimeError(f"a robot ended with exit code {robot.returncode}")
        records = [list(read_trace(trace)) for trace in traces]
    took_s = time.monotonic() - began
    plans, cpu_s = answered(server) - plans, cpu_seconds(server) - cpu_s
    robots_s = children_s() - robots_s
    others_s = machine_s() - busy_s - robots_s - cpu_s
    flat = [record for each in records for record in each]
    waits = [record["waited_s"] * 1e3 for record in flat]
    by_server = sum(record["used"] == "cloud" for record in flat)
    cuts = statistics.quantiles(waits, n=20)
    return Step(
        asked_a_s=rate,
        answered_a_s=round(by_server / max(map(span_s, records)), 2),
        by_server=round(by_server / len(flat), 4),
        p50_ms=round(cuts[9], 1),
        p95_ms=round(cuts[18], 1),
        cpu_s=round(cpu_s / plans, 5),
        robots_cpus=round(robots_s / took_s, 2),
        others_cpus=round(max(0.0, others_s / took_s), 2),
        bytes_to_server=round(statistics.fmean(bytes_of(flat, "bytes_out"))),
        bytes_to_robot=round(statistics.fmean(bytes_of(flat, "bytes_in"))),
    )


def drive(
    server: Server, trace: Path, seed: int, *, rate: float, tasks: int, resolution: str
) -> "subprocess.Popen[str]":
    """A robot that sends all its plans to the server, at random instants."""
    flags = {
        "map": MAP,
        "resolution": resolution,
        "cloud": server.endpoint,
        "policy": "cloud",
        "timeout": TIMEOUT_S,
        "arrivals": "poisson",
        "rate": rate / ROBOTS,
        "tasks": tasks,
        "seed": seed,
        "trace": trace,
        "connect": STARTED_S,
    }
    command = [sys.executable, "-m", "offboard.loadgen", "drive", "--jump"]
    command += [text for name, value in flags.items() for text in (f"--{name}", str(value))]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, text=True)


def span_s(records: list[dict[str, Any]]) -> float:
    """From the start of the first task to that of the last one."""
    first, last = (datetime.fromisoformat(str(records[index]["started_at"])) for index in (0, -1))
    return (last - first).total_seconds()


def bytes_of(records: list[dict[str, Any]], direction: str) -> list[int]:
    """The bytes of each run on the server, in one direction."""
    runs = [run for record in records for run in record["executions"]]
    return [run[direction] for run in runs if run["site"] == "cloud" and run["ok"]]


def answered(server: Server) -> float:
    """The plans that the server has made so far, as it counts them."""
    with urllib.request.urlopen(f"http://127.0.0.1:{server.http_port}/metrics", timeout=5) as answer:
        found = OK.search(answer.read().decode())
    return 0.0 if found is None else float(found[1])


def cpu_seconds(server: Server) -> float:
    """CPU time of the server so far."""
    after_name = Path(f"/proc/{server.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(after_name[11]) + int(after_name[12])) / TICKS


def children_s() -> float:
    """CPU time of the robots that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def machine_s() -> float:
    """CPU time that all programs of this machine have used: user, nice, system and interrupts."""
    user, nice, system, _idle, _wait, *interrupts = map(int, Path("/proc/stat").read_text().split()[1:8])
    return (user + nice + system + sum(interrupts)) / TICKS


def memory_mib(server: Server, field: str) -> int:
    """Memory of the server now (VmRSS) or at most (VmHWM)."""
    found = re.search(rf"^{field}:\s*(\d+) kB", Path(f"/proc/{server.pid}/status").read_text(), re.MULTILINE)
    assert found is not None
    return round(int(found[1]) / 1024)


if __name__ == "__main__":
    main()
