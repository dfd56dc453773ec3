"""Writing the trace, and reading it."""

import json
import logging
import os
import re
import resource
import subprocess
import sys
import time
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import pytest

from offboard.common.errors import CloudTimeout, ConfigError, DataError
from offboard.loadgen.robot_files import read_trace
from offboard.robot_client.learning.regret import Regret
from offboard.robot_client.learning.savings import Savings
from offboard.robot_client.policies import Decision, Hedge, Outlook
from offboard.robot_client.policies.forecast import Packing
from offboard.robot_client.records.record import Late, Record
from offboard.robot_client.records.trace import WAITING_MAX, Trace
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, Condition, Execution, Packed, Sending

ROOT = Path(__file__).parents[2]


def record(i: int = 0) -> Record:
    return Record(
        i=i,
        id=f"s-{i}",
        kind="plan_path",
        size=1.5,
        sites={
            ONBOARD: Outlook(predicted_s=0.1, spread_s=0.01, full=True, age=3, low_s=0.08, high_s=0.15),
            CLOUD: Outlook(
                failures=1,
                condition=Condition(round_trip_s=0.03, queue=2),
                packing=Packing((1,), 2000, 500.0, 0.25),
                sending=Sending(2010, ((1, 2000),)),
            ),
        },
        decision=Decision(CLOUD, "cloud 1 ms against onboard 2 ms", "paper", second=Hedge(ONBOARD, 0.5)),
        executions=(
            Execution(
                CLOUD,
                2.0,
                failure=CloudTimeout("late"),
                censored=True,
                bytes_out=10,
                packed=(Packed(1, "zstd", 2000, bytes=400, seconds=0.2),),
                held_up=True,
            ),
            Execution(ONBOARD, 0.1, queue_s=0.0, run_s=0.1, network_s=0.0, cpu_s=0.02, after_s=2.0),
        ),
        used=ONBOARD,
        waited_s=2.1,
        amount=70.0,
        work=60.0,
        started_s=12.5,
        timeout_s=3.0,
        late=(Late("s-7", Execution(CLOUD, 0.4, run_s=0.3)),),
        regret=Regret(0.01, 0.0, 0.02, 9),
        started_at=datetime(2026, 1, 2, 3, 4, 5, tzinfo=timezone.utc),
        deadline_s=2.0,
        savings=Savings(0.03, 0.02, 0.04, tasks=50, sent=0.5, probes=8, quality_s=0.2),
    )


def ran(site: str, seconds: float, **more: Any) -> dict[str, Any]:
    """An execution as a line holds it."""
    unknown = dict.fromkeys(("error", "queue_s", "run_s", "network_s", "cpu_s"))
    plain = {"ok": True, "censored": False, "started": True, "held_up": False, "packed": [], "after_s": 0.0}
    return {"site": site, "seconds": seconds, "bytes_out": 0, "bytes_in": 0} | unknown | plain | more


def test_a_line_holds_every_field_of_the_format(tmp_path: Path) -> None:
    """A record becomes one JSON line with the fields of docs/formats.md."""
    trace = Trace(tmp_path / "trace.jsonl")
    trace.write(record())
    trace.close()
    (line,) = (tmp_path / "trace.jsonl").read_text().splitlines()
    assert json.loads(line) == {
        "v": 1,
        "i": 0,
        "id": "s-0",
        "kind": "plan_path",
        "started_at": "2026-01-02T03:04:05.000+00:00",
        "started_s": 12.5,
        "timeout_s": 3.0,
        "size": 1.5,
        "work": 60.0,
        "features": {
            "work": 70.0,
            "cloud.round_trip_s": 0.03,
            "cloud.silent": False,
            "cloud.queue": 2,
            "cloud.load": 0.0,
            "cloud.wait_s": 0.0,
            "cloud.capacity": 1.0,
            "cloud.server_load": 0.0,
            "cloud.queue_s": 0.0,
        },
        "sites": {
            "onboard": {
                "predicted_s": 0.1,
                "spread_s": 0.01,
                "low_s": 0.08,
                "high_s": 0.15,
                "age": 3,
                "failures": 0,
                "quality": None,
                "packing": None,
                "sending": None,
            },
            "cloud": {
                "predicted_s": None,
                "spread_s": None,
                "low_s": None,
                "high_s": None,
                "age": 0,
                "failures": 1,
                "quality": None,
                "packing": {"compress": [1], "raw_bytes": 2000, "bytes": 500.0, "seconds": 0.25},
                "sending": {"bytes": 2010, "large": [[1, 2000]]},
            },
        },
        "decision": {
            "site": "cloud",
            "both": False,
            "reason": "cloud 1 ms against onboard 2 ms",
            "policy": "paper",
            "second": "onboard",
            "second_after_s": 0.5,
            "spared": [],
            "advised": None,
            "waits": False,
            "latest_s": None,
        },
        "executions": [
            ran(
                "cloud",
                2.0,
                ok=False,
                error="CloudTimeout: late",
                censored=True,
                bytes_out=10,
                packed=[{"argument": 1, "how": "zstd", "raw_bytes": 2000, "bytes": 400, "seconds": 0.2}],
                held_up=True,
            ),
            ran("onboard", 0.1, queue_s=0.0, run_s=0.1, network_s=0.0, cpu_s=0.02, after_s=2.0),
        ],
        "used": "onboard",
        "happened": "cloud failed after 2 s (CloudTimeout: late); "
        "onboard started after 2 s instead; "
        "onboard answered after 2.1 s; the deadline of 2 s was missed",
        "cancelled": False,
        "refused": None,
        "chunk": None,
        "waited_s": 2.1,
        "deadline_s": 2.0,
        "late": [{"id": "s-7", **ran("cloud", 0.4, run_s=0.3)}],
        "regret": {"mean_s": 0.01, "low_s": 0.0, "high_s": 0.02, "probes": 9},
        "savings": {
            "mean_s": 0.03,
            "low_s": 0.02,
            "high_s": 0.04,
            "tasks": 50,
            "sent": 0.5,
            "probes": 8,
            "quality_s": 0.2,
        },
    }


def test_a_torn_last_line_is_skipped_with_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """After a power loss the last line may lack its end. The others are read."""
    path = write(tmp_path, 3)
    with path.open("a") as file:
        file.write('{"v": 1, "i": 3, "id"')
    with caplog.at_level(logging.WARNING):
        assert [fields["i"] for fields in read_trace(path)] == [0, 1, 2]
    assert f"{path}:4: torn last line skipped" in caplog.text


def test_a_restarted_robot_appends_after_a_torn_line(tmp_path: Path) -> None:
    """Opening a torn trace removes the torn line, so that the next record is complete."""
    path = write(tmp_path, 2)
    os.truncate(path, path.stat().st_size - 5)
    trace = Trace(path)
    trace.write(record(7))
    trace.close()
    assert [fields["i"] for fields in read_trace(path)] == [0, 7]


@pytest.mark.parametrize("text", ["my thesis", "my thesis\nchapter 1\n", '{"a": 1}'])
def test_a_file_that_is_no_trace_is_left_alone(tmp_path: Path, text: str) -> None:
    """A file that is no trace is refused and stays unchanged."""
    path = tmp_path / "thesis.txt"
    path.write_text(text)
    with pytest.raises(ConfigError, match="is no trace"):
        Trace(path)
    assert path.read_text() == text


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("not json\n", ":2: not a JSON line"),
        ("[1]\n", ":2: list where an object was expected"),
        ('{"v": 2}\n', ":2: v = 2; this version reads 1"),
        ('{"v": 1, "i": 0}\n', ":2: no field 'id'"),
    ],
)
def test_any_other_bad_line_names_file_and_line(tmp_path: Path, line: str, message: str) -> None:
    """A bad line in the middle is an error."""
    path = write(tmp_path, 1)
    with path.open("a") as file:
        file.write(line)
    with pytest.raises(DataError, match=f"{path}{message}"):
        list(read_trace(path))


def test_a_missing_trace_is_an_error(tmp_path: Path) -> None:
    """The error names the file."""
    with pytest.raises(DataError, match=r"none\.jsonl: No such file"):
        list(read_trace(tmp_path / "none.jsonl"))


def test_a_trace_that_cannot_be_opened_is_a_config_error(tmp_path: Path) -> None:
    """A directory with the name of the trace is an error at start."""
    with pytest.raises(ConfigError, match="is a folder, not a plain file"):
        Trace(tmp_path)


def test_a_full_disk_is_logged_and_tasks_go_on(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A record that does not fit is counted, leaves no torn line, and does not affect the next one."""
    path = write(tmp_path, 1)
    trace = Trace(path)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 50, limits[1]))
    try:
        for i in (1, 2):
            trace.write(record(i))
        until_s = time.monotonic() + 5
        while trace.lost < 2:
            assert time.monotonic() < until_s
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    trace.write(record(3))
    trace.close()
    assert [fields["i"] for fields in read_trace(path)] == [0, 3]
    logged = [one.getMessage() for one in caplog.records]
    assert len(logged) == 1, "only the first loss is logged"
    assert re.match(r"trace .*: a line is lost: (File too large|no space left)", logged[0])


def test_a_closed_trace_ignores_records(tmp_path: Path) -> None:
    """A task that ends after `close` leaves neither a line nor an error. Closing twice is allowed."""
    trace = Trace(tmp_path / "trace.jsonl")
    trace.write(record(0))
    trace.close()
    trace.write(record(1))
    trace.close()
    assert trace.lost == 0
    assert [fields["i"] for fields in read_trace(trace.path)] == [0]


def test_records_are_written_in_the_background(tmp_path: Path) -> None:
    """Without `close` or `flush`, at most WAITING_MAX records wait, and soon none."""
    trace = Trace(tmp_path / "trace.jsonl")
    for i in range(WAITING_MAX + 3):
        trace.write(record(i))
    written = len(list(read_trace(trace.path)))
    assert WAITING_MAX + 3 - written <= WAITING_MAX + 1, (
        "WAITING_MAX records may wait, and one may be half written"
    )
    until_s = time.monotonic() + 10
    while len(list(read_trace(trace.path))) < WAITING_MAX + 3:
        assert time.monotonic() < until_s
    assert [fields["i"] for fields in read_trace(trace.path)] == list(range(WAITING_MAX + 3))
    trace.close()


def test_a_program_that_does_not_close_the_trace_loses_nothing(tmp_path: Path) -> None:
    """The waiting records are written when the interpreter exits."""
    path = tmp_path / "trace.jsonl"
    program = (
        "from pathlib import Path; from tests.unit.test_trace import Trace, record; "
        f"trace = Trace(Path({str(path)!r})); trace.write(record(0)); trace.write(record(1))"
    )
    subprocess.run([sys.executable, "-c", program], cwd=ROOT, check=True)
    assert [fields["i"] for fields in read_trace(path)] == [0, 1]


def write(folder: Path, count: int) -> Path:
    trace = Trace(folder / "trace.jsonl")
    for i in range(count):
        trace.write(record(i))
    trace.close()
    return trace.path
