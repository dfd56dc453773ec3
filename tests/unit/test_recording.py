"""What a robot asked for, from the files that it left: the same as it really asked for."""

import json
from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from offboard.common.errors import DataError
from offboard.loadgen.drive_record import DriveRecord
from offboard.loadgen.export.recording import Recording, plan_of, read_recording
from offboard.loadgen.robot import answers
from offboard.loadgen.robot_files import drive_path, read_trace
from tests.drives import drive
from tests.mazes import warm

warm()  # compiles before the clock of any test runs
OPEN = {"jump": True, "arrivals": "constant", "rate": 200.0, "in_flight": 3}


def trace_of(folder: Path) -> Path:
    return folder / "trace.jsonl"


def change(path: Path, edit: Callable[[list[dict[str, Any]]], list[dict[str, Any]]]) -> None:
    """Write the lines of a file anew."""
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    path.write_text("".join(json.dumps(line) + "\n" for line in edit(lines)))


def assert_asked(recording: Recording, asked: list[tuple[Any, ...]]) -> None:
    """The recording has these requests, to the last digit."""
    assert len(recording.tasks) == len(asked)
    for task, (grid, scan, pose, goal, *rest) in zip(recording.tasks, asked, strict=True):
        found_grid, found_scan, *found = task.request
        np.testing.assert_array_equal(found_grid.cells, grid.cells)
        np.testing.assert_array_equal(found_scan.ranges, scan.ranges)
        assert found == [pose, goal, *rest]


@pytest.mark.parametrize(
    "settings",
    [{}, {"jump": True}, OPEN, {"sizes": ("uniform:0:3",)}, {"seed": 8, "planner": "astar"}],
    ids=["drives", "jumps", "open", "sizes", "settings"],
)
def test_the_robot_asks_again_for_what_it_asked(tmp_path: Path, settings: dict[str, Any]) -> None:
    """Map, scan, pose and goal of every task are those of the run, and so is every path."""
    asked = drive(tmp_path, **settings)
    recording = read_recording(trace_of(tmp_path))
    assert_asked(recording, asked)
    assert recording.left_out == 0
    for task, (grid, *_) in zip(recording.tasks, asked, strict=True):
        plan = plan_of(task.line, grid)
        assert plan is not None
        assert plan.status == "NONE"
        np.testing.assert_array_equal(plan.metres, grid.metres(plan.cells).astype(np.float32))


def test_failed_tasks_are_part_of_the_recording(tmp_path: Path) -> None:
    """After a failed task the robot picks another goal; the task has no path, and no site answered it."""
    asked = drive(tmp_path, picky=True, tasks=20)
    recording = read_recording(trace_of(tmp_path))
    assert_asked(recording, asked)
    failed = [plan_of(task.line, recording.grid) is None for task in recording.tasks]
    assert failed == [int(goal.x) % 3 == 0 for _, _, _, goal, *_ in asked]
    assert 0 < sum(failed) < 20
    assert [task.decided.used is None for task in recording.tasks] == failed


def test_times_come_from_the_clock_of_the_answers(tmp_path: Path) -> None:
    """The first task began when the trace says, and the others as much later as the answers say."""
    drive(tmp_path)
    tasks = read_recording(trace_of(tmp_path)).tasks
    records, lines = list(read_trace(trace_of(tmp_path))), list(answers.read(tmp_path / "answers.jsonl"))
    first = datetime.fromisoformat(records[0]["started_at"]).timestamp()
    assert tasks[0].begin_ns == pytest.approx(first * 1e9, abs=1e3)
    for task, line, record in zip(tasks, lines, records, strict=True):
        later_s, took_s = line["began_s"] - lines[0]["began_s"], line["ended_s"] - line["began_s"]
        assert task.begin_ns - tasks[0].begin_ns == pytest.approx(later_s * 1e9, abs=2)
        assert task.end_ns - task.begin_ns == pytest.approx(took_s * 1e9, abs=2)
        assert task.decided.waited_ms == 1e3 * record["waited_s"]


def test_a_robot_that_was_started_again_has_two_clocks(tmp_path: Path) -> None:
    """The answers of each process count from its own first task; the trace says when that was."""
    drive(tmp_path, jump=True)
    change(tmp_path / "answers.jsonl", lambda lines: lines[:5])
    before = trace_of(tmp_path).read_text()
    drive(tmp_path, jump=True)
    assert trace_of(tmp_path).read_text().startswith(before)

    def a_day_later(lines: list[dict[str, Any]]) -> list[dict[str, Any]]:
        times = [
            datetime.fromisoformat(line["started_at"]) + timedelta(days=n >= 12)
            for n, line in enumerate(lines)
        ]
        return [line | {"started_at": time.isoformat()} for line, time in zip(lines, times, strict=True)]

    change(trace_of(tmp_path), a_day_later)
    recording = read_recording(trace_of(tmp_path))
    begins_s = [(task.begin_ns - recording.tasks[0].begin_ns) / 1e9 for task in recording.tasks]
    assert begins_s == sorted(begins_s)
    assert [round(begin_s / 86_400) for begin_s in begins_s] == [0] * 5 + [1] * 7
    assert recording.left_out == 7, "seven answers of the first process are lost"


def test_after_a_missing_answer_only_jumps_are_known(tmp_path: Path) -> None:
    """A robot that drives goes on from where the missing path ended, so the tasks after it are left out."""
    for name, jump, known in (("drive", False, 5), ("jump", True, 11)):
        folder = tmp_path / name
        folder.mkdir()
        asked = drive(folder, jump=jump)
        change(folder / "answers.jsonl", lambda lines: [line for line in lines if line["i"] != 5])
        recording = read_recording(trace_of(folder))
        assert_asked(recording, [one for i, one in enumerate(asked) if i != 5][:known])
        assert recording.left_out == 12 - known


def test_a_task_without_a_line_in_the_trace_is_left_out(tmp_path: Path) -> None:
    """Its path is known, so the robot goes on; its decision and times are not."""
    asked = drive(tmp_path)
    change(trace_of(tmp_path), lambda lines: [line for line in lines if line["i"] != 5])
    recording = read_recording(trace_of(tmp_path))
    assert_asked(recording, asked[:5] + asked[6:])
    assert recording.left_out == 1


def other_seed(lines: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [line | {"settings": line["settings"] | {"seed": 99}} for line in lines]


def unknown_setting(lines: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [line | {"settings": line["settings"] | {"speed": 1}} for line in lines]


def short_map(lines: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [line | {"map": line["map"] | {"shape": [1, 2]}} for line in lines]


def without_sites(lines: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [line | {"sites": 3} for line in lines]


def without(name: str) -> Callable[[list[dict[str, Any]]], list[dict[str, Any]]]:
    return lambda lines: [{key: value for key, value in line.items() if key != name} for line in lines]


def with_answer(**fields: Any) -> Callable[[list[dict[str, Any]]], list[dict[str, Any]]]:
    return lambda lines: [line | {"answer": line["answer"] | fields} for line in lines]


@pytest.mark.parametrize(
    ("name", "edit", "said"),
    [
        ("trace.drive.jsonl", other_seed, "task 0 does not fit the robot that is driven again by trace."),
        ("trace.drive.jsonl", unknown_setting, "unknown key 'speed'"),
        ("trace.drive.jsonl", short_map, "trace.drive.jsonl: no drive record: ValueError"),
        ("trace.drive.jsonl", without("map"), "trace.drive.jsonl:1: no field 'map'"),
        ("trace.drive.jsonl", lambda _: [], "trace.drive.jsonl: there is no whole line in it"),
        ("answers.jsonl", lambda _: [], "none of its tasks is in "),
        ("answers.jsonl", with_answer(start=[5000, 1]), "task 0 does not fit the robot"),
        ("answers.jsonl", with_answer(start="here"), "task 0: its lines are wrong: "),
        ("answers.jsonl", with_answer(steps="9"), "steps '9' contain a character other than 0 to 7"),
        ("trace.jsonl", without_sites, "task 0: its lines are wrong: "),
    ],
)  # fmt: skip
def test_files_that_do_not_fit_together_are_refused(
    tmp_path: Path, name: str, edit: Callable[[list[dict[str, Any]]], list[dict[str, Any]]], said: str
) -> None:
    """The error names the file and what is wrong, and nothing is guessed."""
    drive(tmp_path)
    change(tmp_path / name, edit)
    with pytest.raises(DataError) as error:
        read_recording(trace_of(tmp_path))
    assert said in str(error.value)
    assert str(tmp_path) in str(error.value) or said.startswith("steps")


def test_a_run_may_be_moved_to_another_folder(tmp_path: Path) -> None:
    """The drive record holds the map, and finds the answers next to itself."""
    here, there = tmp_path / "here", tmp_path / "there"
    here.mkdir()
    drive(here)
    here.rename(there)
    record = DriveRecord.read(trace_of(there))
    assert record.answers == there / "answers.jsonl"
    assert drive_path(trace_of(there)).stat().st_size < record.prior.cells.size, "the map is compressed"
    assert len(read_recording(trace_of(there)).tasks) == 12
