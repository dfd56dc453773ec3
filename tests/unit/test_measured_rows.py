"""Reading measured rows from traces and CSV datasets."""

import json
import logging
from pathlib import Path

import pytest

from offboard.common.errors import CloudTimeout, ConfigError, DataError
from offboard.loadgen.table import measured_rows as rows
from offboard.robot_client.policies import Decision
from offboard.robot_client.records.record import Record, as_dict
from offboard.robot_client.records.trace import Trace
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, Execution

HEADER = "size,onboard_s,cloud_s\n"


def record(i: int, *executions: Execution, size: float = 1.0, kind: str = "plan_path") -> Record:
    decision = Decision(ONBOARD, "test", "paper", both=len(executions) > 1)
    return Record(i, str(i), kind, size, {}, decision, executions, ONBOARD, 0.1)


def write_trace(path: Path, *records: Record) -> Path:
    trace = Trace(path)
    for one in records:
        trace.write(one)
    trace.close()
    return path


def write_csv(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def test_a_trace_gives_its_tasks_with_both_times(tmp_path: Path) -> None:
    """Tasks that both sites answered become rows, in order; the other tasks are counted as left out."""
    late = CloudTimeout("late")
    again = Execution(ONBOARD, 0.5), Execution(ONBOARD, 0.9)  # the first successful time of a site counts
    path = write_trace(
        tmp_path / "trace.jsonl",
        record(1, Execution(ONBOARD, 0.3), Execution(CLOUD, 0.1), size=7.0),
        record(2, Execution(ONBOARD, 0.4)),
        record(3, Execution(ONBOARD, 0.4), Execution(CLOUD, 9.0, failure=late, censored=True)),
        record(4, Execution(ONBOARD, 0.4), Execution(CLOUD, 9.0, failure=late)),
        record(5, Execution(ONBOARD, 0.4, censored=True), Execution(CLOUD, 0.2)),
        record(6, Execution(CLOUD, 0.2), Execution("edge", 0.05), *again, size=8.0),
    )
    found = rows.read(path)
    assert found.size.tolist() == [7.0, 8.0]
    assert found.onboard_s.tolist() == [0.3, 0.5]
    assert found.cloud_s.tolist() == [0.1, 0.2]
    assert found.left_out == 4


def test_a_trace_without_a_measured_task_says_how_to_measure(tmp_path: Path) -> None:
    """A trace without a task on both sites is an error that names --measure both."""
    chosen = (record(1, Execution(ONBOARD, 0.3)), record(2, Execution(CLOUD, 0.3)))
    path = write_trace(tmp_path / "t.jsonl", *chosen)
    with pytest.raises(DataError, match=r"t\.jsonl: no task was answered by both sites.*--measure both"):
        rows.read(path)


def test_a_torn_last_line_is_skipped(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A trace that a power loss cut off is read up to its last whole line, with a warning."""
    path = write_trace(tmp_path / "t.jsonl", record(1, Execution(ONBOARD, 0.3), Execution(CLOUD, 0.1)))
    with path.open("a") as file:
        file.write('{"v": 1, "i"')
    with caplog.at_level(logging.WARNING):
        assert len(rows.read(path)) == 1
    assert "torn last line" in caplog.text


def test_a_trace_with_several_kinds_needs_a_choice(tmp_path: Path) -> None:
    """Kinds are not mixed in one window: the error names them, and `kind` selects one."""
    both = (Execution(ONBOARD, 0.3), Execution(CLOUD, 0.1))
    path = write_trace(tmp_path / "t.jsonl", record(1, *both), record(2, *both, kind="empty", size=0.0))
    with pytest.raises(DataError, match=r"several kinds: plan_path \(line 1\), empty \(line 2\); .*--kind"):
        rows.read(path)
    assert rows.read(path, "empty").size.tolist() == [0.0]
    with pytest.raises(DataError, match="no walk was answered by both sites"):
        rows.read(path, "walk")


@pytest.mark.parametrize(
    ("field", "value", "expected"),
    [
        ("size", "big", r"t\.jsonl:2: size: 'big' is not a finite number from 0"),
        ("size", 10**400, r"t\.jsonl:2: size: 1000.*\.\. is not"),
        ("size", float("nan"), r"t\.jsonl:2: size: nan is not"),
        ("executions", 3, r"t\.jsonl:2: executions: .*each needs site, seconds, ok and censored"),
        ("executions", [{"site": "onboard", "ok": True}], r"t\.jsonl:2: executions: KeyError\('censored'\)"),
        (
            "executions",
            [{"site": "onboard", "ok": True, "censored": False, "seconds": -1}],
            r"t\.jsonl:2: seconds of onboard: -1 is not a finite number from 0",
        ),
        (
            "executions",
            [{"site": ["onboard"], "ok": True, "censored": False, "seconds": 1}],
            r"t\.jsonl:2: executions: TypeError",
        ),
    ],
)
def test_a_wrong_value_in_a_trace_is_an_error_with_its_line(
    tmp_path: Path, field: str, value: object, expected: str
) -> None:
    """The error names file, line, field and value."""
    good = as_dict(record(1, Execution(ONBOARD, 0.3), Execution(CLOUD, 0.1)))
    path = write_csv(
        tmp_path / "t.jsonl", json.dumps(good) + "\n" + json.dumps({**good, field: value}) + "\n"
    )
    with pytest.raises(DataError, match=expected):
        rows.read(path)


def test_csv_columns_are_found_by_name(tmp_path: Path) -> None:
    """The order of the columns, further columns, blank lines, a byte order mark and CRLF do not matter."""
    text = "\ufeffcloud_s,size,note,onboard_s\r\n0.5,3,far,0.25\r\n\r\n0,4,,1e-3\r\n"
    found = rows.read(write_csv(tmp_path / "d.CSV", text))
    assert (found.size.tolist(), found.onboard_s.tolist()) == ([3, 4], [0.25, 0.001])
    assert found.cloud_s.tolist() == [0.5, 0]
    assert found.left_out == 0


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", r"d\.csv:1: the header is missing; the first line must be size,onboard_s,cloud_s"),
        ("\n1,2,3\n", r"d\.csv:1: the header is missing"),
        (HEADER, r"d\.csv: there are no rows below the header"),
        (
            "size,onboard_s\n1,2\n",
            r"d\.csv:1: header 'size,onboard_s' has no column 'cloud_s'; it must be",
        ),
        ("1,2,3\n1,2,3\n", r"d\.csv:1: header '1,2,3' has no column 'size'"),
        ("size,size,onboard_s,cloud_s\n", r"d\.csv:1: .* has the column 'size' twice"),
        (HEADER + "1,2,3\n1,fast,3\n", r"d\.csv:3: onboard_s: 'fast' is not a finite number from 0"),
        (HEADER + "1,2,\n", r"d\.csv:2: cloud_s: '' is not a finite"),
        (HEADER + "nan,2,3\n", r"d\.csv:2: size: 'nan' is not a finite"),
        (HEADER + "1,inf,3\n", r"d\.csv:2: onboard_s: 'inf' is not a finite"),
        (HEADER + "1,2,-3\n", r"d\.csv:2: cloud_s: '-3' is not a finite"),
        (HEADER + "1,2,1e16\n", r"d\.csv:2: cloud_s: '1e16' is not a finite number from 0 to 1e\+15"),
        (HEADER + "1,2\n", r"d\.csv:2: 2 cells, but the header has 3"),
        (HEADER + "1,0,5,0,7\n", r"d\.csv:2: 5 cells, but the header has 3"),
        (HEADER + "1," + "9" * 200_000 + ",3\n", r"d\.csv:2: field larger than field limit"),
    ],
)
def test_a_wrong_csv_is_an_error_with_its_line(tmp_path: Path, text: str, expected: str) -> None:
    """The error has one line and names file, line, column, value, and what is allowed."""
    with pytest.raises(DataError, match=expected) as caught:
        rows.read(write_csv(tmp_path / "d.csv", text))
    assert "\n" not in str(caught.value)


def test_a_file_that_cannot_be_read_is_an_error(tmp_path: Path) -> None:
    """A missing file, a folder, and a file that is not text are errors that name the file."""
    (tmp_path / "folder.csv").mkdir()
    (tmp_path / "image.csv").write_bytes(b"\xff\xd8\xff\xe0")
    for name, expected in (
        ("none", "No such file"),
        ("folder", "Is a directory"),
        ("image", "not UTF-8 text"),
    ):
        with pytest.raises(DataError, match=rf"{name}\.csv: {expected}"):
            rows.read(tmp_path / f"{name}.csv")
    with pytest.raises(DataError, match=r"none\.jsonl: No such file"):
        rows.read(tmp_path / "none.jsonl")


def test_a_kind_is_refused_for_a_csv(tmp_path: Path) -> None:
    """A CSV has no kinds, so that --kind is an error and is not ignored."""
    with pytest.raises(ConfigError, match="--kind: 'plan_path' works only with traces"):
        rows.read(write_csv(tmp_path / "d.csv", HEADER + "1,2,3\n"), "plan_path")


def test_the_number_of_rows_is_limited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file at the limit is read, a longer one is refused."""
    path = write_csv(tmp_path / "d.csv", HEADER + "1,2,3\n" * 4)
    monkeypatch.setattr(rows, "ROWS_MAX", 4)
    assert len(rows.read(path)) == 4
    monkeypatch.setattr(rows, "ROWS_MAX", 3)
    with pytest.raises(DataError, match="more than 3 rows"):
        rows.read(path)
