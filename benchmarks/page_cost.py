"""What the port of a robot costs a task while nobody looks, in instructions of the processor.

Callgrind counts them, so that the figures hardly depend on what else the machine does.
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from benchmarks.measure import Requirement, Table
from offboard.common.tasks import task
from offboard.robot_client.offloader import Offloader

FEW, MANY = 1_500, 4_500  # tasks; the last 1,000 records are kept from FEW on
COLLECTED = re.compile(rb"Collected : (\d+)")
ADDRESS = "127.0.0.1:0"


@task("page_cost", size=lambda: 1.0)
def nothing() -> None:
    """The shortest task: next to it, everything else is large."""


def no_port(count: int) -> None:
    with Offloader.connect() as offload:
        _run(offload, count)


def port_without_page(count: int) -> None:
    """The metrics alone: no record is kept for a page."""
    with Offloader.connect(metrics=ADDRESS) as offload:
        recording = offload._life.recording
        assert recording is not None
        assert recording.live is not None
        recording.live.keep = lambda _: None
        _run(offload, count)


def port(count: int) -> None:
    with Offloader.connect(metrics=ADDRESS) as offload:
        _run(offload, count)


CASES: dict[str, Callable[[int], None]] = {one.__name__: one for one in (no_port, port_without_page, port)}
NAMES = {
    "no_port": "no port",
    "port_without_page": "metrics, without the page",
    "port": "metrics and the page",
}


def _run(offload: Offloader, count: int) -> None:
    for _ in range(count):
        offload(nothing)


def tables() -> list[Table]:
    columns = ("an empty task onboard", "instructions", "more than without a port")
    if shutil.which("valgrind") is None:
        return [
            Table(
                "The cost of a page that nobody looks at", columns, [], missing=["valgrind is not installed"]
            )
        ]
    found = {case: (_instructions(case, MANY) - _instructions(case, FEW)) / (MANY - FEW) for case in CASES}
    base = found["no_port"]
    rows = [[NAMES[case], f"{each:,.0f}", f"{each / base - 1:.2%}"] for case, each in found.items()]
    page = Requirement(
        "the page, relative to the metrics alone", found["port"] / found["port_without_page"] - 1, 0.005
    )
    return [Table("The cost of a page that nobody looks at", columns, rows, [page])]


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
    CASES[sys.argv[1]](int(sys.argv[2]))
