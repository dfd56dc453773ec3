"""A trace whose disk takes nothing any more: tasks go on, what is lost is counted, and `close` ends.

The file of the trace is exchanged for a pipe that nobody reads, so that its writes block as on a hung disk.
"""

import contextlib
import fcntl
import itertools
import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from prometheus_client import CollectorRegistry

from offboard import Offloader
from offboard.loadgen.robot_files import read_trace
from offboard.robot_client.records import trace as trace_module
from offboard.robot_client.records.metrics import Metrics
from offboard.robot_client.records.trace import ROOM_WAIT_S, WAITING_MAX, Trace
from tests.probes import echo
from tests.unit.test_trace import record

ROOT = Path(__file__).parents[2]
MARGIN_S = 1.0  # for a busy machine


class Disk:
    """Stalls the file of a trace, and lets it go on."""

    def __init__(self, trace: Trace) -> None:
        self._trace = trace
        self._file = os.dup(trace._file.fileno())
        self._unread, pipe = os.pipe()
        fcntl.fcntl(pipe, fcntl.F_SETPIPE_SZ, 4096)
        os.dup2(pipe, trace._file.fileno())
        os.close(pipe)

    def go_on(self) -> None:
        """What was written while the disk was stalled is gone."""
        with contextlib.suppress(OSError):
            os.dup2(self._file, self._trace._file.fileno())
        while os.read(self._unread, 1 << 20):
            pass

    def close(self) -> None:
        os.close(self._unread)  # a write that still blocks ends with an error
        os.close(self._file)


@pytest.fixture
def stall(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[Trace], Disk]]:
    """Stalls the disk of a trace; `close` then waits a tenth of a second."""
    monkeypatch.setattr(trace_module, "CLOSE_WAIT_S", 0.1)
    disks: list[Disk] = []

    def start(trace: Trace) -> Disk:
        disks.append(Disk(trace))
        return disks[-1]

    yield start
    for disk in disks:
        disk.close()


def errors(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [one.getMessage() for one in caplog.records if one.name == "offboard.robot_client.records.lines"]


def fill(trace: Trace, count: int) -> float:
    """Add records; return the longest time that one of them took, in seconds."""
    longest_s = 0.0
    for i in range(count):
        began_s = time.monotonic()
        trace.write(record(i))
        longest_s = max(longest_s, time.monotonic() - began_s)
    return longest_s


def test_a_stalled_disk_stops_no_task(
    tmp_path: Path, stall: Callable[[Trace], Disk], caplog: pytest.LogCaptureFixture
) -> None:
    """WAITING_MAX records are kept, the others are counted, one line is logged, and `close` ends."""
    trace = Trace(tmp_path / "trace.jsonl")
    stall(trace)
    began_s = time.monotonic()
    assert fill(trace, 3 * WAITING_MAX) < ROOM_WAIT_S + MARGIN_S
    assert time.monotonic() - began_s < ROOM_WAIT_S + 3 * MARGIN_S, "only the first task may wait"
    assert len(trace._waiting) == WAITING_MAX
    in_pipe = 3 * WAITING_MAX - WAITING_MAX - trace.lost
    assert 0 <= in_pipe < 10
    began_s = time.monotonic()
    trace.close()
    trace.close()
    assert time.monotonic() - began_s < 0.1 + MARGIN_S
    assert trace.lost == 3 * WAITING_MAX - in_pipe
    assert errors(caplog) == [
        f"trace {trace.path}: a line is lost: {WAITING_MAX} records wait for the disk; "
        "others are only counted; remedy: free the disk"
    ]


def test_a_disk_that_works_again_gets_new_records(tmp_path: Path, stall: Callable[[Trace], Disk]) -> None:
    """Records that waited are written, and a later stall makes one task wait again."""
    trace = Trace(tmp_path / "trace.jsonl")
    disk = stall(trace)
    fill(trace, WAITING_MAX + 50)
    lost = trace.lost
    assert lost > 0
    thread = threading.Thread(target=disk.go_on, daemon=True)
    thread.start()
    until_s = time.monotonic() + 5
    while trace._waiting:
        assert time.monotonic() < until_s
        time.sleep(0.01)
    trace.write(record(9999))
    trace.close()
    assert trace.lost == lost
    assert [fields["i"] for fields in read_trace(trace.path)][-1] == 9999


def test_many_threads_lose_nothing_while_the_disk_works(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Tasks that are faster than the disk wait for it; each record is written once."""
    monkeypatch.setattr(trace_module, "ROOM_WAIT_S", 60.0)  # a busy machine is no disk that hangs
    trace = Trace(tmp_path / "trace.jsonl")
    numbers = itertools.count()

    def work() -> None:
        for _ in range(WAITING_MAX):
            trace.write(record(next(numbers)))

    threads = [threading.Thread(target=work) for _ in range(4)]
    for one in threads:
        one.start()
    for one in threads:
        one.join()
    trace.close()
    assert trace.lost == 0
    assert sorted(fields["i"] for fields in read_trace(trace.path)) == list(range(4 * WAITING_MAX))


def test_the_lost_records_are_a_metric(tmp_path: Path, stall: Callable[[Trace], Disk]) -> None:
    """Prometheus reads how many records the trace has lost so far; 0 from the start."""
    registry = CollectorRegistry()
    trace = Trace(tmp_path / "trace.jsonl")
    Metrics(registry).watch(trace)
    assert registry.get_sample_value("offboard_robot_trace_lost_records_total") == 0
    stall(trace)
    fill(trace, WAITING_MAX + 100)
    assert registry.get_sample_value("offboard_robot_trace_lost_records_total") == trace.lost > 0
    trace.close()


def test_a_record_that_is_no_json_is_lost_alone(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A policy of the user may decide anything; the thread goes on with the next record."""
    odd: Any = record(1)
    odd.used = object()
    trace = Trace(tmp_path / "trace.jsonl")
    for one in (record(0), odd, record(2)):
        trace.write(one)
    trace.close()
    assert trace.lost == 1
    assert [fields["i"] for fields in read_trace(trace.path)] == [0, 2]
    assert "a line is lost: TypeError: " in errors(caplog)[0]


def test_an_offloader_answers_and_closes_on_a_stalled_disk(
    tmp_path: Path, stall: Callable[[Trace], Disk]
) -> None:
    """Every task is answered, and `close` returns."""
    offload = Offloader.connect(trace=tmp_path / "trace.jsonl")
    assert offload._life.recording is not None
    trace = offload._life.recording.observers[0].__self__  # type: ignore[attr-defined]
    stall(trace)
    count = WAITING_MAX + 200
    assert [offload(echo, number) for number in range(count)] == list(range(count))
    assert trace.lost > 0
    began_s = time.monotonic()
    offload.close()
    assert time.monotonic() - began_s < 0.1 + MARGIN_S


def test_a_program_ends_although_the_disk_has_stalled(tmp_path: Path) -> None:
    """Without `close` the exit of the interpreter waits CLOSE_WAIT_S, and the loss is one line."""
    program = (
        "import sys; from pathlib import Path; from tests.unit.test_stalled_trace import *; "
        "trace_module.CLOSE_WAIT_S = 0.2; trace = Trace(Path(sys.argv[1])); disk = Disk(trace); "
        "fill(trace, 50)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path / "trace.jsonl")],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=9,
    )
    assert done.returncode == 0
    assert re.fullmatch(r"trace .*: a line is lost: it is not written within 0.2 s; .*\n", done.stderr)
