"""The trace and the metrics that `Offloader.connect` keeps by itself."""

import logging
import re
import subprocess
import sys
import threading
import urllib.request
from pathlib import Path
from urllib.error import URLError

import pytest

from offboard import ConfigError, Offloader
from offboard.loadgen.robot_files import read_trace
from tests.probes import echo

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.integration


def test_an_offloader_serves_metrics_and_writes_a_trace_until_it_is_closed(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Both have every task. After the close the port is free and the file complete; closing twice is safe."""
    caplog.set_level(logging.INFO, logger="offboard.robot_client")
    path, before = tmp_path / "new" / "trace.jsonl", threading.active_count()
    with Offloader.connect(metrics="127.0.0.1:0", trace=str(path)) as offload:
        assert [offload(echo, number) for number in range(3)] == [0, 1, 2]
        found = re.search(r"metrics: (http://127\.0\.0\.1:(\d+)/metrics)", caplog.text)
        assert found is not None
        text = urllib.request.urlopen(found[1], timeout=5).read().decode()
        assert 'offboard_robot_tasks_total{kind="echo",site="onboard"} 3.0' in text
    offload.close()
    assert [record["i"] for record in read_trace(path)] == [0, 1, 2]
    with pytest.raises(URLError):
        urllib.request.urlopen(found[1], timeout=5)
    with Offloader.connect(metrics=f"127.0.0.1:{found[2]}", trace=path) as again:
        again(echo)
    assert len(list(read_trace(path))) == 4
    names = {thread.name for thread in threading.enumerate()} - {"load"}
    assert threading.active_count() <= before + 1, names


@pytest.mark.parametrize(
    ("metrics", "error"),
    [
        ("9100", "metrics: '9100' is not HOST:PORT with a port from 0 to 65535"),
        ("127.0.0.1:99999", "metrics: '127.0.0.1:99999' is not HOST:PORT"),
        ("192.0.2.1:9100", "metrics: 192.0.2.1:9100 cannot be served: "),
    ],
)
def test_a_bad_address_of_metrics_is_named(tmp_path: Path, metrics: str, error: str) -> None:
    """The trace that was opened before is closed again."""
    with pytest.raises(ConfigError, match=re.escape(error)):
        Offloader.connect(metrics=metrics, trace=tmp_path / "trace.jsonl")
    assert "trace" not in {thread.name for thread in threading.enumerate()}


def test_a_wrong_endpoint_closes_trace_and_metrics(tmp_path: Path) -> None:
    """Nothing is left open after a ConfigError."""
    with pytest.raises(ConfigError, match="is not tcp://HOST:PORT"):
        Offloader.connect("cloud:5555", metrics="127.0.0.1:0", trace=tmp_path / "trace.jsonl")
    assert "trace" not in {thread.name for thread in threading.enumerate()}


def test_a_full_disk_costs_the_trace_and_no_task(tmp_path: Path) -> None:
    """If the trace cannot be written, all tasks are answered, and the run says so and exits with 1."""
    trace = tmp_path / "trace.jsonl"
    command = ["prlimit", "--fsize=1500", sys.executable, "-m", "offboard.loadgen", "call"]
    command += [
        "--task",
        "tests.probes:swallow",
        "--sizes",
        "constant:1",
        "--tasks",
        "20",
        "--trace",
        str(trace),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=30, cwd=ROOT, check=False)
    assert done.returncode == 1
    assert "20 tasks" in done.stdout
    lost = re.search(rf"(\d+) tasks could not be written to {trace}", done.stderr)
    assert lost is not None
    assert 0 < int(lost[1]) == 20 - len(list(read_trace(trace)))
