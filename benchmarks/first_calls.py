"""Measures the first calls of a new robot: a task of 100 ms, and a server behind a link of 800 ms."""

import tempfile
from collections.abc import Iterator
from pathlib import Path

from benchmarks.deadline_tasks import SLEEP_SERVER_S, sleep_alike
from benchmarks.measure import Requirement, Table
from offboard import Offloader
from offboard.loadgen.testbed.local_testbed import LocalTestbed
from offboard.loadgen.testbed.testbed import CLOUD, WAN, Setup
from offboard.robot_client.records.record import Record

ROUND_TRIP_MS = 800.0
CALLS = 6  # of each robot
ROBOTS = 20
LIMIT_MS = 130.0
CONNECT_S = 60.0


def play(robots: int, folder: Path) -> list[list[Record]]:
    """The records of the first calls of each robot; all use the same server."""
    setups = {
        CLOUD: Setup({"tasks": "benchmarks.deadline_tasks", "workers": 8}),
        WAN: Setup({"delay_ms": ROUND_TRIP_MS / 2}),
    }
    played = []
    with LocalTestbed(folder, setups) as bed:
        bed.start()
        for _ in range(robots):
            records = list[Record]()
            with Offloader.connect(bed.endpoint, timeout_s=10.0, observers=[records.append]) as offload:
                offload.wait_for_sites(sleep_alike, CONNECT_S)
                for number in range(CALLS):
                    offload(sleep_alike, number)
            played.append(records)
    return played


def table(played: list[list[Record]]) -> Table:
    rows = []
    for n in range(CALLS):
        waits_ms = sorted(1e3 * records[n].waited_s for records in played)
        row = [f"{waits_ms[len(waits_ms) // 2]:.1f}", f"{waits_ms[-1]:.1f}"]
        rows.append([str(n + 1), *row, str(sum(len(records[n].executions) > 1 for records in played))])
    longest_ms = max(1e3 * one.waited_s for records in played for one in records)
    title = f"First calls: a task of {SLEEP_SERVER_S * 1e3:g} ms, a link of {ROUND_TRIP_MS:g} ms"
    columns = ["call", "median ms", "longest ms", f"also sent to the server, of {len(played)}"]
    return Table(title, columns, rows, [Requirement("the longest call", longest_ms, LIMIT_MS, "ms")])


def tables() -> Iterator[Table]:
    with tempfile.TemporaryDirectory() as folder:
        yield table(play(ROBOTS, Path(folder)))
