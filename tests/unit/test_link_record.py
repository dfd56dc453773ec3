"""The record of what the link did: complete, bounded, and honest about missing lines."""

import json
import os
from pathlib import Path
from typing import Any

import pytest

from offboard.common.errors import ConfigError
from offboard.loadgen.relay.link.link import Link, LinkConditions
from offboard.loadgen.relay.link.pipe import Pipe
from offboard.loadgen.relay.tcp import link_record as module
from offboard.loadgen.relay.tcp.link_record import LinkRecord


def read(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_lines_are_written_in_order_with_times_since_the_start(tmp_path: Path) -> None:
    """The file holds all lines in order, with seconds since the start, and a last line with the counts."""
    path = tmp_path / "link.jsonl"
    record = LinkRecord(path, 100.0)
    record.conditions(100.0, "flag", Link(LinkConditions(delay_ms=3, samples=(1.0, 2.0))))
    record.opened(101.0, 1)
    pipe = Pipe(LinkConditions(delay_ms=15), 0, 1, "up")
    due_s = pipe.due(101.5, 10)
    for size, delivered_s in ((10, 101.516), (0, None)):
        chunk = record.chunk(1, "up", pipe, segment=0, size=size, arrived_s=101.5, due_s=due_s)
        record.delivered(chunk, delivered_s)
    record.closed(102.0, 1, "client")
    record.close(103.0)
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


def test_lines_beyond_the_memory_bound_are_dropped_and_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While the disk does not write, the memory stays within its bound; the last line counts the losses."""
    monkeypatch.setattr(module, "WAITING_BYTES_MAX", 1000)
    monkeypatch.setattr(module, "WRITE_S", 3600.0)
    path = tmp_path / "link.jsonl"
    os.mkfifo(path)
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    record = LinkRecord(path, 0.0)
    for number in range(2000):
        record.opened(0.0, number)
    assert record.status()["dropped"] >= 1900
    assert sum(record.status().values()) == 2000
    record.close(1.0)
    os.set_blocking(reader, True)
    with os.fdopen(reader) as pipe:
        lines = [json.loads(line) for line in pipe]
    assert lines[-1] == {"what": "end", "at_s": 1.0, **record.status()}
    assert len(lines) == record.status()["lines"] + 1


def test_a_full_disk_ends_the_record_and_not_the_relay(tmp_path: Path, caplog: Any) -> None:
    """Lines that cannot be written are counted as dropped, and there is one warning."""
    path = tmp_path / "link.jsonl"
    path.symlink_to("/dev/full")
    record = LinkRecord(path, 0.0)
    record.opened(0.0, 1)
    record.close(1.0)
    record.opened(2.0, 2)
    assert record.status() == {"lines": 0, "dropped": 2}
    assert caplog.text.count("cannot write the record of the link: No space left on device") == 1


def test_a_path_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    """The error names the flag, the path and the reason."""
    with pytest.raises(ConfigError, match=f"--truth: cannot write {tmp_path}: Is a directory"):
        LinkRecord(tmp_path, 0.0)
