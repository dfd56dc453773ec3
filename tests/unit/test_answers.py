"""The answers file: what a line holds, and how a run continues from it after a crash."""

import json
import logging
import resource
from pathlib import Path

import numpy as np
import pytest

from offboard.common.errors import BadValue, ConfigError, DataError
from offboard.common.planning import planner
from offboard.common.planning.maps import GridMap
from offboard.common.planning.planner import Plan, Point, Pose, plan_path
from offboard.loadgen.robot.answers import (
    STEPS,
    Answered,
    Answers,
    cells_of,
    of_plan,
    of_value,
    read,
)

planner.warm()  # compiles before the clock of any test runs


def answered(i: int) -> Answered:
    return Answered(i, f"s-{i}", 0.5 * i, 0.5 * i + 0.1, 0.5 * i + 0.3, None, {"sha256": "00"})


def write(path: Path, *numbers: int) -> Path:
    answers = Answers(path)
    answers.begin()
    for i in numbers:
        answers.write(answered(i))
    answers.close()
    return path


def done(path: Path) -> frozenset[int]:
    """The tasks that have an answer for a restarted run."""
    answers = Answers(path)
    answers.close()
    return answers.done


def test_a_line_holds_every_field_of_the_format(tmp_path: Path) -> None:
    """One answer becomes one JSON line with the fields of docs/formats.md."""
    path = write(tmp_path / "new" / "answers.jsonl", 2)
    (line,) = path.read_text().splitlines()
    assert json.loads(line) == {
        "v": 1,
        "i": 2,
        "id": "s-2",
        "due_s": 1.0,
        "began_s": 1.1,
        "ended_s": 1.3,
        "error": None,
        "answer": {"sha256": "00"},
    }


def test_the_file_is_made_when_the_run_begins(tmp_path: Path) -> None:
    """`begin` creates an empty file, once; opening alone creates nothing."""
    path = tmp_path / "answers.jsonl"
    answers = Answers(path)
    assert not path.exists()
    answers.begin()
    answers.begin()
    assert path.read_bytes() == b""
    answers.close()
    assert done(path) == frozenset()


def test_a_restarted_run_continues_after_the_answers(tmp_path: Path) -> None:
    """It knows the answered tasks; a torn last line is cut off and does not count."""
    path = write(tmp_path / "answers.jsonl", 0, 3, 1)
    whole = path.read_bytes()
    with path.open("a") as file:
        file.write('{"v":1,"i":2,"id":"s-2"')
    answers = Answers(path)
    assert answers.done == {0, 1, 3}
    assert path.read_bytes() == whole
    answers.write(answered(2))
    answers.close()
    assert [fields["i"] for fields in read(path)] == [0, 3, 1, 2]


@pytest.mark.parametrize(
    ("text", "error", "message"),
    [
        ("my thesis\n", ConfigError, "answers .* the file exists and is no answers"),
        ('{"v":1,"i":0,"id":"s-0","kind":"echo"}\n', DataError, ":1: no field 'due_s'"),
        ('{"v":2}\n', DataError, ":1: v = 2"),
        ('{"v":1,"i":-1,"id":"","due_s":0,"began_s":0,"ended_s":0,"error":"","answer":0}\n',
         DataError, "i = -1 is not a task number"),
    ],
)  # fmt: skip
def test_a_file_of_another_kind_is_refused_and_not_changed(
    tmp_path: Path, text: str, error: type[Exception], message: str
) -> None:
    """A trace or a text in place of the answers is an error that names it."""
    path = tmp_path / "file.jsonl"
    path.write_text(text)
    with pytest.raises(error, match=message):
        Answers(path)
    assert path.read_text() == text


def test_a_full_disk_loses_answers_but_ends_no_run(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """An answer that does not fit is logged and counted, leaves no torn line, and is asked again later."""
    path = write(tmp_path / "answers.jsonl", 0)
    answers = Answers(path)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 50, limits[1]))
    try:
        with caplog.at_level(logging.ERROR):
            answers.write(answered(1))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert f"answers {path}: a line is lost: " in caplog.text
    answers.write(answered(2))
    answers.close()
    assert answers.lost == 1
    assert done(path) == {0, 2}


@pytest.mark.parametrize("seed", range(5))
def test_the_steps_of_a_plan_are_its_cells(seed: int) -> None:
    """A real path with turns in all directions survives JSON, cell by cell."""
    random = np.random.default_rng(seed)
    grid = GridMap(np.where(random.random((60, 60)) < 0.25, 100, 0).astype(np.int8), 0.5)
    free = grid.metres(np.argwhere(grid.cells == 0).astype(np.int32))
    (x, y), (to_x, to_y) = free[random.integers(len(free), size=2)]
    plan = plan_path(grid, None, Pose(x, y), Point(to_x, to_y), 0.0)
    answer = json.loads(json.dumps(of_plan(plan)))
    assert (answer["status"], answer["cost"], answer["expanded"]) == (plan.status, plan.cost, plan.expanded)
    assert cells_of(answer).tolist() == plan.cells.tolist()


def test_each_digit_is_its_step() -> None:
    """Digits count eighths of a turn; a path of one cell has no steps, no path has no start."""

    def plan(cells: list[tuple[int, int]]) -> Plan:
        return Plan("NONE", np.array(cells, np.int32).reshape(-1, 2), np.zeros((0, 2), np.float32), 1.0, 1)

    for digit, (row, col) in enumerate(STEPS):
        answer = of_plan(plan([(5, 5), (5 + row, 5 + col)]))
        assert (answer["start"], answer["steps"]) == ([5, 5], str(digit))
        turn = np.arctan2(row, col) % (2 * np.pi)
        assert turn == pytest.approx(digit * np.pi / 4)
    assert (of_plan(plan([(2, 3)]))["start"], of_plan(plan([(2, 3)]))["steps"]) == ([2, 3], "")
    assert of_plan(plan([]))["start"] is None
    assert cells_of(of_plan(plan([]))).shape == (0, 2)
    for jump in ((5, 7), (5, 5), (3, 4)):
        with pytest.raises(DataError, match="not a neighbour"):
            of_plan(plan([(5, 5), jump]))


def test_a_value_is_named_by_the_digest_of_its_bytes() -> None:
    """Equal results have equal digests, and another content of an array has another digest."""
    numbers = np.arange(5.0)
    digest = of_value({"a": (1, 2), "b": numbers}, ())["sha256"]
    assert len(digest) == 64
    assert of_value({"a": [1, 2], "b": numbers.copy()}, ())["sha256"] == digest
    numbers[4] = np.nextafter(4.0, 5.0)
    assert of_value({"a": [1, 2], "b": numbers}, ())["sha256"] != digest
    with pytest.raises(BadValue, match="cannot be sent"):
        of_value(object(), ())


def test_a_folder_in_place_of_the_file_is_a_config_error(tmp_path: Path) -> None:
    """The error is raised at start."""
    with pytest.raises(ConfigError, match="is a folder, not a plain file"):
        Answers(tmp_path)
    assert list(tmp_path.iterdir()) == []
