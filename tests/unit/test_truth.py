"""The relay's record of the truth: whole, bounded, and honest about what it lacks."""

import json
import os
from pathlib import Path
from typing import Any

import pytest

from offboard.common.errors import ConfigError
from offboard.loadgen.relay.link.link import Link, LinkConditions, Pipe
from offboard.loadgen.relay.tcp import link_record as module
from offboard.loadgen.relay.tcp.link_record import Truth


def read(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_lines_are_written_in_order_with_times_since_the_start(tmp_path: Path) -> None:
    """What was told comes out as it was told, in seconds since the start, and the last line counts."""
    path = tmp_path / "link.jsonl"
    truth = Truth(path, 100.0)
    truth.conditions(100.0, "flag", Link(LinkConditions(delay_ms=3, samples=(1.0, 2.0))))
    truth.opened(101.0, 1)
    pipe = Pipe(LinkConditions(delay_ms=15), 0, 1, "up")
    due_s = pipe.due(101.5, 10)
    truth.delivered(truth.chunk(1, "up", 0, 10, 101.5, due_s, pipe), 101.516)
    truth.delivered(truth.chunk(1, "up", 0, 0, 101.5, due_s, pipe), None)
    truth.closed(102.0, 1, "client")
    truth.close(103.0)
    lines = read(path)
    assert [line["what"] for line in lines] == ["conditions", "opened", "chunk", "chunk", "closed", "end"]
    assert (lines[0]["by"], lines[0]["up"]["delay_ms"], lines[0]["up"]["samples"]) == ("flag", 3, 2)
    assert lines[2] == {
        "what": "chunk",
        "connection": 1,
        "direction": "up",
        "segment": 0,
        "bytes": 10,
        "arrived_s": 1.5,
        "drawn_ms": 15.0,
        "stall_ms": 0.0,
        "due_s": 1.515,
        "delivered_s": 1.516,
    }
    assert lines[3]["delivered_s"] is None
    assert lines[4] == {"what": "closed", "at_s": 2.0, "connection": 1, "how": "client"}
    assert lines[5] == {"what": "end", "at_s": 3.0, "lines": 5, "dropped": 0}


def test_what_memory_cannot_hold_is_dropped_and_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While the disk stands still, no more than the bound waits; the last line says what is missing."""
    monkeypatch.setattr(module, "WAITING_BYTES_MAX", 1000)
    monkeypatch.setattr(module, "WRITE_S", 3600.0)
    path = tmp_path / "link.jsonl"
    os.mkfifo(path)
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    truth = Truth(path, 0.0)
    for number in range(2000):
        truth.opened(0.0, number)
    assert truth.status()["dropped"] >= 1900
    assert sum(truth.status().values()) == 2000
    truth.close(1.0)
    os.set_blocking(reader, True)
    with os.fdopen(reader) as pipe:
        lines = [json.loads(line) for line in pipe]
    assert lines[-1] == {"what": "end", "at_s": 1.0, **truth.status()}
    assert len(lines) == truth.status()["lines"] + 1


def test_a_full_disk_ends_the_truth_not_the_relay(tmp_path: Path, caplog: Any) -> None:
    """What cannot be written is counted as dropped, and said once."""
    path = tmp_path / "link.jsonl"
    path.symlink_to("/dev/full")
    truth = Truth(path, 0.0)
    truth.opened(0.0, 1)
    truth.close(1.0)
    truth.opened(2.0, 2)
    assert truth.status() == {"lines": 0, "dropped": 2}
    assert caplog.text.count("cannot write the truth: No space left on device") == 1


def test_a_truth_that_cannot_be_written_is_a_mistake_of_the_user(tmp_path: Path) -> None:
    """A path that cannot be opened is refused with flag, path and reason."""
    with pytest.raises(ConfigError, match=f"--truth: cannot write {tmp_path}: Is a directory"):
        Truth(tmp_path, 0.0)
