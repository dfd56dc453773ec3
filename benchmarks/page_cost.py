"""What the port of a robot costs a task while nobody looks, in instructions of the processor.

Callgrind counts them, so the figures hardly depend on what else the machine does. Two runs differ by 1 %.
"""

import itertools
import os
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from datetime import datetime, timedelta, timezone
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from benchmarks.decision import SIZES, WINDOW, InstantRunner, counted
from benchmarks.measure import Requirement, Table
from offboard.robot_client import offloader, policies, predictors
from offboard.robot_client.learning.memories import Memories
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.records.metrics import Metrics, serve_metrics
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

FEW, MANY = 1_500, 4_500  # tasks
COLLECTED = re.compile(rb"Collected : (\d+)")
ROUNDS = 3
BAR = 0.005
TASK = timedelta(milliseconds=1)


def no_port() -> list[Metrics]:
    return []


def metrics_alone() -> list[Metrics]:
    """No record is kept for a page."""
    (served,) = metrics_and_page()
    served.live.due_at = datetime.max.replace(tzinfo=timezone.utc)
    return [served]


def let_time_pass() -> None:
    """Let a task take TASK for the page, as on a real robot: counting instructions slows it down."""
    begun, tasks = datetime.now(timezone.utc), itertools.count()
    offloader.datetime = SimpleNamespace(now=lambda _: begun + next(tasks) * TASK)


def metrics_and_page() -> list[Metrics]:
    return [serve_metrics("127.0.0.1:0", "address")]


CASES: dict[str, Callable[[], list[Metrics]]] = {
    "no port": no_port,
    "metrics alone": metrics_alone,
    "metrics and page": metrics_and_page,
}


class StandingClock:
    """Time stands still, so that every run takes the same way through the code."""

    def now_s(self) -> float:
        return 0.0

    def wait(self, pending: "Sequence[Future[Any]]", timeout_s: float | None = None) -> None:  # noqa: ARG002
        assert pending[0].done(), "the runners answer at once"


def run(observers: list[Metrics], count: int) -> None:
    """Make tasks whose runs end at once: next to a real run, what is counted here is little."""
    offload = Offloader(
        [InstantRunner(ONBOARD), InstantRunner(CLOUD)],
        policy=policies.make(policies.DEFAULT),
        memories=Memories(lambda: predictors.make(predictors.PARTS, WINDOW), shared_work=True),
        observers=observers,
        clock=StandingClock(),
    )
    for n in range(count):
        offload(counted, SIZES[n % len(SIZES)])


def tables() -> list[Table]:
    columns = ("a task whose run ends at once", "instructions", "more than without a port")
    if shutil.which("valgrind") is None:
        return [
            Table(
                "The cost of a page that nobody looks at", columns, [], missing=["valgrind is not installed"]
            )
        ]
    rounds = [{case: _of_a_task(case) for case in CASES} for _ in range(ROUNDS)]
    found = {case: statistics.median(one[case] for one in rounds) for case in CASES}
    none, alone, page = found.values()
    rows = [[case, f"{each:,.0f}", f"{each / none - 1:.2%}"] for case, each in found.items()]
    bar = Requirement("the page, relative to the metrics alone", page / alone - 1, BAR)
    return [Table("The cost of a page that nobody looks at", columns, rows, [bar])]


def _of_a_task(case: str) -> float:
    """The start of the process counts in both runs, so that it is not in the difference."""
    return (_instructions(case, MANY) - _instructions(case, FEW)) / (MANY - FEW)


def _instructions(case: str, count: int) -> int:
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "callgrind.out"
        command = [
            "valgrind",
            "--tool=callgrind",
            f"--callgrind-out-file={out}",
            sys.executable,
            "-m",
            __spec__.name,
        ]
        done = subprocess.run(
            [*command, case, str(count)],
            env=os.environ | {"PYTHONHASHSEED": "0"},
            stderr=subprocess.PIPE,
            check=True,
        )
    collected = COLLECTED.search(done.stderr)
    assert collected is not None, done.stderr
    return int(collected[1])


if __name__ == "__main__":
    let_time_pass()
    run(CASES[sys.argv[1]](), int(sys.argv[2]))
