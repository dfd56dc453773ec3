"""A recorded link through a real relay: its delays and bytes are those that the file says."""

import contextlib
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from offboard.loadgen.scenario.scenario_file import LINKS
from tests.relays import read_record, receive, stop, wait_until

pytestmark = pytest.mark.integration

RURAL, TRAM = LINKS / "5g" / "5g-rural.csv", LINKS / "3g" / "3g-tram.csv"
RURAL_FROM_S, TRAM_FROM_S = 20.0, 500.0
PLAYED_S = 25.0
HELD_S = 20.0  # longer than the recording holds a message
EVERY_S = 0.01  # between two messages
STAMP = 8  # bytes of a message: the time when it was sent, in ns
WINDOW_S = 5.0


def rows(file: Path) -> Any:
    return np.loadtxt(file, delimiter=",", skiprows=1)


def sink(got: list[tuple[int, int]]) -> Any:
    """Keeps for each message when it was sent and when it came."""

    def talk(connection: socket.socket) -> None:
        connection.settimeout(HELD_S)
        while stamp := receive(connection, STAMP):
            got.append((int.from_bytes(stamp), time.monotonic_ns()))

    return talk


@pytest.mark.timeout(90)
def test_delays_are_those_of_the_recording(cloud: Any, wan: Any, tmp_path: Path) -> None:
    """A 5G run: numpy computes the same due times, and on the socket no message comes early.

    Other load of the machine makes messages late, so only a quarter of them must come within 2 ms. The due
    times of a few differ, because the record rounds the times at which rows change.
    """
    got: list[tuple[int, int]] = []
    truth = tmp_path / "link.jsonl"
    flags = ("--recording", str(RURAL), "--recording-from-s", f"{RURAL_FROM_S:g}", "--truth", str(truth))
    relay = wan(cloud(sink(got)), *flags, "--bandwidth-mbps", "0")
    with relay.connect() as client:
        start_s, count = time.monotonic(), round(PLAYED_S / EVERY_S)
        for number in range(count):
            time.sleep(max(0.0, start_s + number * EVERY_S - time.monotonic()))
            client.sendall(time.monotonic_ns().to_bytes(STAMP))
        wait_until(lambda: len(got) == count)
    stop(relay)
    sent, came = np.array(got).T / 1e9
    entered, due, begun = entries(read_record(truth))
    zero = np.max(sent - entered)  # of the relay's clock on ours: it reads a message soon after it was sent
    seconds, rtt_ms = rows(RURAL).T
    now = rtt_ms[np.searchsorted(seconds, RURAL_FROM_S + entered - begun, side="right") - 1]
    expected = np.maximum.accumulate(entered + now / 2e3)
    assert np.mean(np.abs(due - expected) < 1e-5) > 0.98
    expected_ms, found_ms = 1e3 * (expected - entered), 1e3 * (came - zero - entered)
    for percent in (50, 95, 99):
        found, rule, recorded = (np.percentile(ms, percent) for ms in (found_ms, expected_ms, now / 2))
        print(f"P{percent}: {found:.1f} ms, by the rule {rule:.1f}, half the trip {recorded:.1f}")
    earliest, quarter = np.percentile(found_ms - 1e3 * (due - entered), (0, 25))
    print(f"on the socket at least {earliest:.2f} ms late, a quarter at most {quarter:.2f} ms")
    assert earliest > -0.5
    assert quarter < 2.0
    assert np.percentile(expected_ms, 99) > 300  # the run holds messages back


def test_bytes_are_those_of_the_recording(cloud: Any, wan: Any) -> None:
    """A tram on 3G: in every 5 s, as many bytes come out as its rates say, within 3 %."""
    came: list[tuple[float, int]] = []

    def talk(connection: socket.socket) -> None:
        while data := connection.recv(65536):
            came.append((time.monotonic(), len(data)))

    flags = ("--recording", str(TRAM), "--recording-from-s", f"{TRAM_FROM_S:g}", "--recording-waits")
    relay = wan(cloud(talk), *flags, "--delay-ms", "0")
    with relay.connect() as client:
        assert relay.ask("POST", "/recording")[0] == 200
        start_s = time.monotonic()
        threading.Thread(target=flood, args=(client,), daemon=True).start()
        time.sleep(PLAYED_S)
    seconds, mbps = rows(TRAM).T
    passed = np.concatenate([[0.0], np.cumsum(np.diff(seconds) * mbps[:-1] * 125_000)])
    at, sizes = np.array(came).T
    for start in np.arange(0.0, PLAYED_S - 0.1, WINDOW_S):
        inside = (at - start_s >= start) & (at - start_s < start + WINDOW_S)
        low, high = np.interp(TRAM_FROM_S + np.array([start, start + WINDOW_S]), seconds, passed)
        print(f"from {start:g} s: {sizes[inside].sum():.0f} bytes, recorded {high - low:.0f}")
        assert sizes[inside].sum() == pytest.approx(high - low, rel=0.03)


def entries(lines: list[dict[str, Any]]) -> tuple[Any, Any, float]:
    """When the relay read each message, when it was due, and when the recording began, on its clock."""
    (begun,) = [line["at_s"] for line in lines if line.get("by") == "recording"]
    chunks = [line for line in lines if line["what"] == "chunk" and line["direction"] == "up"]
    counts = [line["bytes"] // STAMP for line in chunks]  # several may be read at once
    arrived, due = (np.repeat([line[name] for line in chunks], counts) for name in ("arrived_s", "due_s"))
    return arrived, due, begun


def flood(client: socket.socket) -> None:
    with contextlib.suppress(OSError):
        while True:
            client.sendall(bytes(65536))


def test_a_recorded_quantity_is_refused_over_http(cloud: Any, wan: Any, tmp_path: Path) -> None:
    """Outages act on top; the record of the link holds the hash of the file."""
    truth = tmp_path / "link.jsonl"
    relay = wan(cloud(sink([])), "--recording", str(RURAL), "--truth", str(truth))
    status, answer = relay.ask("PUT", "/link", {"delay_ms": 3})
    assert (status, answer["detail"]) == (
        422,
        "up.delay_ms: cannot be changed, because it is recorded in 5g-rural.csv",
    )
    assert relay.ask("PUT", "/link", {"recording": "x"})[0] == 422
    shown = relay.change(outage=True)
    assert shown["up"]["recording"]["columns"] == ["rtt_ms"]
    stop(relay)
    lines = [line for line in read_record(truth) if line["what"] == "conditions"]
    assert [line["by"] for line in lines] == ["flag", "recording", "http"]
    assert {line["down"]["recording"]["sha256"] for line in lines} == {shown["down"]["recording"]["sha256"]}


def test_a_link_without_a_recording_begins_none(cloud: Any, wan: Any) -> None:
    """POST /recording says what is missing."""
    status, answer = wan(cloud(sink([]))).ask("POST", "/recording")
    assert (status, answer["detail"]) == (
        422,
        "recording: this link plays none; remedy: start the relay with --recording",
    )


@pytest.mark.parametrize(("text", "line"), [("0.0,30\n", 1), ("t_s,rtt_ms\n0,nan\n", 2)])
def test_a_bad_file_ends_the_relay_with_one_line(tmp_path: Path, text: str, line: int) -> None:
    """It names file and line, and the exit code is 2."""
    file = tmp_path / "run.csv"
    file.write_text(text)
    command = [sys.executable, "-m", "offboard.loadgen", "wan", "--recording", str(file)]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=30)
    assert (ended.returncode, ended.stdout) == (2, "")
    assert ended.stderr.count("\n") == 1
    assert f"{file}:{line}: " in ended.stderr
