"""Reading recorded links: every format, and one line for every mistake that names file and line."""

import os
from pathlib import Path

import pytest

from offboard.common.errors import DataError
from offboard.loadgen.relay.link import recording_file
from offboard.loadgen.relay.link.recording_file import BYTES_MAX, GAP_S, ROWS_MAX, read_recording


def written(folder: Path, text: str, name: str = "run.csv") -> Path:
    file = folder / name
    file.write_text(text)
    return file


@pytest.mark.parametrize(
    ("text", "columns"),
    [
        ("t_s,rtt_ms\n5.0,30\n5.5,20\n", {"rtt_ms": [30, 20]}),
        ("t_s,mbps\n5.0,0\n5.5,2.5\n", {"mbps": [0, 2.5]}),
        ("t_s, down_mbps, up_mbps\n5.0,8,1\n\n5.5,9,0\n", {"down_mbps": [8, 9], "up_mbps": [1, 0]}),
        ("\ufefft_s,mbps,rtt_ms\r\n5.0,1,30\r\n5.5,2,20\r\n", {"mbps": [1, 2], "rtt_ms": [30, 20]}),
    ],
)
def test_a_table_is_read(tmp_path: Path, text: str, columns: dict[str, list[float]]) -> None:
    """Times count from the first row, and the last row holds as long as rows usually do."""
    found = read_recording(written(tmp_path, text))
    assert {name: list(values) for name, values in found.columns.items()} == columns
    assert list(found.times) == pytest.approx([0.0, 0.5, 1.0])


def test_a_long_gap_is_cut_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """The row before it holds for the usual time, and one line says what was cut."""
    file = written(tmp_path, "t_s,rtt_ms\n0,30\n0.5,31\n1.0,32\n31.0,33\n41.0,34\n")
    found = read_recording(file)
    assert list(found.times) == pytest.approx([0, 0.5, 1.0, 1.5, 1.5 + GAP_S, 2.0 + GAP_S])
    assert caplog.messages == [
        f"{file}: gaps of more than 10 s that were cut out: 1, of 29.5 s; remedy: add rows if it was silent"
    ]


def test_the_packet_times_of_mahimahi_are_read(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Each line lets one packet of 1,500 bytes pass in its millisecond; a long silence is kept."""
    found = read_recording(written(tmp_path, "1\n1\n4\n20004\n20005\n", "verizon.down"))
    assert list(found.times) == pytest.approx([0, 0.001, 0.003, 0.004, 20.003, 20.004, 20.005])
    assert list(found.columns["mbps"]) == pytest.approx([24, 0, 12, 0, 12, 12])
    assert caplog.messages == []


@pytest.mark.parametrize(
    ("text", "line", "wrong"),
    [
        ("", 1, "the file is empty"),
        ("0.0,30\n0.1,31\n", 1, "the first line '0.0,30' is no header"),
        ("t_s,delay\n0,1\n", 1, "the first line 't_s,delay' is no header"),
        ("t_s\n0\n", 1, "the first line 't_s' is no header"),
        ("t_s,mbps,up_mbps\n0,1,1\n", 1, "'t_s,mbps,up_mbps': mbps is the rate of both directions"),
        ("t_s,rtt_ms\n", 1, "no rows follow the header"),
        ("t_s,rtt_ms\n0,30\n2,30\n1,30\n", 4, "t_s: 1 is before 2"),
        ("t_s,rtt_ms\n0,-3\n", 2, "rtt_ms: '-3' is not a number from 0 to 120000"),
        ("t_s,rtt_ms\n0,30\n\n1,nan\n", 4, "rtt_ms: 'nan' is not a number"),
        ("t_s,mbps\ninf,3\n", 2, "t_s: 'inf' is not a number"),
        ("t_s,mbps\n0,3,4\n", 2, "3 values, but the header names 2"),
        ("t_s,mbps\n0,\n", 2, "mbps: '' is not a number"),
        ("5\n4\n", 2, "4 is before 5"),
        ("5\n6.5\n", 2, "'6.5' is not a time in whole ms"),
    ],
)
def test_a_wrong_row_is_named(tmp_path: Path, text: str, line: int, wrong: str) -> None:
    """One line names the file, the line, the value and what is allowed."""
    file = written(tmp_path, text)
    with pytest.raises(DataError) as caught:
        read_recording(file)
    assert str(caught.value).startswith(f"{file}:{line}: {wrong}")
    assert "\n" not in str(caught.value)


def test_a_dead_link_is_refused(tmp_path: Path) -> None:
    """A rate that is never above 0 would hold every message for ever."""
    with pytest.raises(DataError, match="mbps is never above 0"):
        read_recording(written(tmp_path, "t_s,mbps\n0,0\n1,0\n"))


def test_too_many_rows_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The limit is a million; the line that exceeds it is named."""
    assert ROWS_MAX == 1_000_000
    monkeypatch.setattr(recording_file, "ROWS_MAX", 3)
    read_recording(written(tmp_path, "t_s,mbps\n0,1\n1,1\n2,1\n"))
    file = written(tmp_path, "t_s,mbps\n0,1\n1,1\n2,1\n3,1\n", "long.csv")
    with pytest.raises(DataError, match=r"long\.csv:5: one row too many; a recording has at most 3"):
        read_recording(file)


def test_a_huge_file_is_not_read(tmp_path: Path) -> None:
    """Its size is looked at first, so that a file without line ends does not fill the memory."""
    file = written(tmp_path, "")
    os.truncate(file, BYTES_MAX + 1)
    with pytest.raises(DataError, match=f"{BYTES_MAX + 1} bytes; a recording has at most {BYTES_MAX}"):
        read_recording(file)


def test_only_files_are_opened(tmp_path: Path) -> None:
    """A folder and a FIFO, which would wait for a writer, get one line; so do bytes that are no text."""
    fifo, missing = tmp_path / "fifo", tmp_path / "missing.csv"
    os.mkfifo(fifo)
    (tmp_path / "picture.csv").write_bytes(b"t_s,mbps\n\xff\xfe\n")
    for path, wrong in (
        (tmp_path, f"{tmp_path}: a folder is not a recording"),
        (fifo, f"{fifo}: a FIFO or device is not a recording"),
        (missing, f"{missing}: No such file or directory"),
        (tmp_path / "picture.csv", f"{tmp_path / 'picture.csv'}:2: this is not text"),
    ):
        with pytest.raises(DataError) as caught:
            read_recording(path)
        assert str(caught.value).startswith(wrong)


def test_the_hash_is_that_of_the_file(tmp_path: Path) -> None:
    """A changed file is another recording, also if it was read before."""
    file = written(tmp_path, "t_s,mbps\n0,1\n")
    first = read_recording(file)
    assert read_recording(file) is first
    file.write_text("t_s,mbps\n0,10\n")
    assert read_recording(file).sha256 != first.sha256
