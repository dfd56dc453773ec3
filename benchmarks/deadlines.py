"""Counts missed deadlines, and says why each was missed: a server that stalls, and a link that stalls.

A call is missed for one of three causes: onboard was not started, it was started too late, or it ran longer
than any of its last 100 runs.
"""

import tempfile
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.deadline_tasks import over_a_bad_link, sleep_or_stall
from benchmarks.measure import Requirement, Table
from offboard import DeadlineMissed, Offloader
from offboard.loadgen.testbed.local_testbed import LocalTestbed
from offboard.loadgen.testbed.testbed import CLOUD, WAN, Setup
from offboard.robot_client.records.record import Record
from offboard.robot_client.sites.runner import ONBOARD

CONNECT_S = 30.0
CALLS = 1000  # of each program
ENDED_S = 10.0  # for the records of the last calls
LAST = 100  # runs onboard that a late one is compared with
SLOWER, TOO_LATE, NOT_STARTED = "onboard ran longer than before", "onboard started too late", "no onboard run"


@dataclass(frozen=True, slots=True)
class Program:
    """A task that is called again and again with a deadline, and the link to its server."""

    name: str
    task: Callable[[int], int]
    deadline_s: float
    link: Mapping[str, Any] = field(default_factory=dict)


PROGRAMS = (
    Program("server stalls, loopback", sleep_or_stall, 0.4),
    Program(
        "link stalls",
        over_a_bad_link,
        0.6,
        {"delay_ms": 60.0, "jitter_ms": 30.0, "loss": 0.06, "stall_ms": 700.0, "seed": 1},
    ),
)


@dataclass(frozen=True, slots=True)
class Counted:
    """What became of the calls of a program; `causes` has an entry for each missed one."""

    calls: int
    causes: tuple[str, ...]
    quality: float
    second_runs: int


def play(program: Program, calls: int, folder: Path) -> Counted:
    """Make the calls one after the other with the default policy."""
    records, missed = list[Record](), 0
    setups = {
        CLOUD: Setup({"tasks": "benchmarks.deadline_tasks", "workers": 16}),
        WAN: Setup(dict(program.link)),
    }
    with LocalTestbed(folder, setups) as bed:
        bed.start()
        with Offloader.connect(bed.endpoint, observers=[records.append]) as offload:
            offload.wait_for_sites(program.task, CONNECT_S)
            for number in range(calls):
                try:
                    offload(program.task, number, deadline_s=program.deadline_s)
                except DeadlineMissed:
                    missed += 1
            until_s = time.monotonic() + ENDED_S
            while len(records) < calls and time.monotonic() < until_s:
                time.sleep(0.01)
    return Counted(
        calls, _causes(records, program.deadline_s, missed), _quality(records), _second_runs(records)
    )


def _causes(records: Sequence[Record], deadline_s: float, missed: int) -> tuple[str, ...]:
    """Why calls were missed. One that was answered as its caller gave up counts as started too late."""
    found, last = list[str](), deque[float](maxlen=LAST)
    for record in sorted(records, key=lambda one: one.i):
        onboard = next((one for one in record.executions if one.site == ONBOARD), None)
        if record.waited_s > deadline_s:
            if onboard is None:
                found.append(NOT_STARTED)
            else:
                found.append(SLOWER if last and onboard.seconds > max(last) else TOO_LATE)
        if onboard is not None and onboard.ok:
            last.append(onboard.seconds)
    return tuple(found[:missed] + [TOO_LATE] * (missed - len(found)))


def _quality(records: Sequence[Record]) -> float:
    return sum(one.sites[one.used].quality.value for one in records if one.used) / len(records)


def _second_runs(records: Sequence[Record]) -> int:
    return sum(len(one.executions) > 1 for one in records)


def table(counted: Mapping[str, Counted]) -> Table:
    rows, requirements = [], []
    for name, one in counted.items():
        causes = Counter(one.causes)
        shown = ", ".join(f"{count} x {cause}" for cause, count in causes.items()) or "none"
        twice = f"{one.second_runs / one.calls:.1%}"
        rows.append([name, str(one.calls), shown, f"{one.quality:.3f}", twice])
        avoidable = causes[TOO_LATE] + causes[NOT_STARTED]
        requirements.append(Requirement(f"{name}: onboard too late or not at all", avoidable, 0))
        requirements.append(
            Requirement(f"{name}: slow runs in 1,000 calls", 1e3 * causes[SLOWER] / one.calls, 2)
        )
    columns = ["program", "calls", "missed", "mean quality", "calls with a second run"]
    return Table("Calls with a deadline", columns, rows, requirements)


def tables() -> Iterator[Table]:
    counted = {}
    for program in PROGRAMS:
        with tempfile.TemporaryDirectory() as folder:
            counted[program.name] = play(program, CALLS, Path(folder))
    yield table(counted)
