"""`loadgen export --mcap`: the messages of a run, and mistakes of the user."""

import re
import resource
import subprocess
import sys
from itertools import chain
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import Reader

from offboard.common.errors import ConfigError
from offboard.loadgen.__main__ import main
from offboard.loadgen.export.mcap_file import McapFile, new_mcap, number
from offboard.loadgen.export.recording import plan_of, read_recording
from offboard.ros2.converters import grid_of, path_poses, pose_of, scan_of
from tests.drives import drive
from tests.extras import needs
from tests.mazes import warm
from tests.mcaps import counts, of, read_both

warm()  # compiles before the clock of any test runs
ROOT = Path(__file__).parents[2]


def export(run: Path, *flags: str | Path) -> int:
    return main(["export", str(run), *map(str, flags)])


def test_the_messages_are_those_of_the_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Map, scans, poses, goals and paths come back from the file as the robot had them."""
    asked = drive(tmp_path)
    assert export(tmp_path, "--mcap", tmp_path / "run.mcap") == 0
    said = read_both(tmp_path / "run.mcap")
    assert capsys.readouterr().out.endswith(f"run.mcap (12 tasks, {len(said)} messages)\n")
    recording = read_recording(tmp_path / "trace.jsonl")
    ((_, grid_message),) = of(said, "/map")
    np.testing.assert_array_equal(grid_of(grid_message).cells, recording.grid.cells)
    topics = [of(said, topic) for topic in ("/tf", "/scan", "/pose", "/goal_pose", "/plan")]
    for task, (_, scan, pose, goal, *_), *messages in zip(recording.tasks, asked, *topics, strict=True):
        (moved_ns, moved), (seen_ns, seen), (at_ns, at), (to_ns, to), (path_ns, path) = messages
        assert {moved_ns, seen_ns, at_ns, to_ns} == {task.begin_ns}
        assert path_ns == task.end_ns
        assert at.header.stamp.sec * 10**9 + at.header.stamp.nanosec == task.begin_ns
        place, yaw = pose_of(at.pose), pytest.approx(pose.yaw, abs=1e-9)
        assert (place.x, place.y, place.yaw) == (pose.x, pose.y, yaw)
        assert (to.pose.position.x, to.pose.position.y) == (goal.x, goal.y)
        (transform,) = moved.transforms
        assert (transform.header.frame_id, transform.child_frame_id) == ("map", seen.header.frame_id)
        assert (transform.transform.translation.x, transform.transform.translation.y) == (pose.x, pose.y)
        np.testing.assert_array_equal(scan_of(seen).ranges, scan.ranges)
        planned = plan_of(task.line, recording.grid)
        assert planned is not None
        found = path_poses(path)[:, :2]
        np.testing.assert_allclose(found[[0, -1]], [(pose.x, pose.y), (goal.x, goal.y)])
        np.testing.assert_array_equal(found[1:-1], planned.metres[1:-1].astype(np.float64))


def test_decisions_and_times_are_those_of_the_trace(tmp_path: Path) -> None:
    """Each decision has its site, reason and times as text; predicted, true and waited times are numbers."""
    drive(tmp_path, picky=True, tasks=20)
    assert export(tmp_path / "trace.jsonl", "--mcap", tmp_path / "run.mcap") == 0
    said, tasks = read_both(tmp_path / "run.mcap"), read_recording(tmp_path / "trace.jsonl").tasks
    failed = sum(task.decided.used is None for task in tasks)
    found = counts(said)
    assert found["/plan"] == found["/offboard/true_ms/onboard"] == 20 - failed < 20
    assert found["/diagnostics"] == found["/scan"] == found["/offboard/waited_ms"] == 20
    assert (
        found["/offboard/predicted_ms/onboard"] == sum(bool(task.decided.predicted_ms) for task in tasks) > 0
    )
    for task, (_, message) in zip(tasks, of(said, "/diagnostics"), strict=True):
        (status,) = message.status
        values = {pair.key: pair.value for pair in status.values}
        assert (values["decided"], values["reason"]) == (task.decided.site, task.decided.reason)
        assert values["site"] == (task.decided.used or "none")
        assert status.level == (1 if task.decided.used is None else 0)
        for site, ms in task.decided.true_ms.items():
            assert float(values[f"{site}.true_ms"]) == pytest.approx(ms, abs=0.001)
    waited = [message.data for _, message in of(said, "/offboard/waited_ms")]
    assert waited == [task.decided.waited_ms for task in tasks]
    true = [message.data for _, message in of(said, "/offboard/true_ms/onboard")]
    assert true == list(chain(*(task.decided.true_ms.values() for task in tasks)))


def test_the_topics_are_those_of_the_docs(tmp_path: Path) -> None:
    """docs/formats.md lists every topic with its type, and no other."""
    drive(tmp_path)
    assert export(tmp_path, "--mcap", tmp_path / "run.mcap") == 0
    listed = re.findall(
        r"^\| `(/\S+)` \| (\w+)/(\w+) \|", (ROOT / "docs/formats.md").read_text(), re.MULTILINE
    )
    expected = {topic.replace("SITE", "onboard"): f"{package}/msg/{name}" for topic, package, name in listed}
    with Reader(tmp_path / "run.mcap") as reader:
        assert {one.topic: one.msgtype for one in reader.connections} == expected


def test_messages_of_tasks_at_the_same_time_are_in_the_order_of_time(tmp_path: Path) -> None:
    """With open arrivals tasks overlap, and the file still goes forward in time only."""
    drive(tmp_path, tasks=30, jump=True, arrivals="bursts", burst=10, rate=1000.0, in_flight=4)
    assert export(tmp_path, "--mcap", tmp_path / "run.mcap") == 0
    assert counts(read_both(tmp_path / "run.mcap"))["/plan"] == 30


def test_mistakes_are_one_line_and_leave_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A folder that is no run, a run without a map, and a file that exists are named; nothing is written."""
    monkeypatch.chdir(tmp_path)
    Path("no-run").mkdir()
    Path("calls").mkdir()
    Path("calls/trace.jsonl").touch()
    Path("run").mkdir()
    drive(Path("run"))
    Path("kept.mcap").write_text("kept")
    before = sorted(Path().rglob("*"))
    capsys.readouterr()
    for run, flags, said in (
        ("none", ("--mcap", "a.mcap"), "none: no such file or folder; give the folder of a run"),
        ("no-run", ("--mcap", "a.mcap"), "no-run: this folder has no trace.jsonl"),
        (
            "calls",
            ("--mcap", "a.mcap"),
            "calls/trace.drive.jsonl: no such file; `loadgen run` of a scenario with",
        ),
        ("run", ("--mcap", "kept.mcap"), "--mcap: kept.mcap exists; remove it, or give another file"),
        ("run", ("--mcap", "run"), "--mcap: run exists; remove it"),
        ("run", ("--mcap", "kept.mcap/a.mcap"), "--mcap: kept.mcap/a.mcap cannot be written: "),
        ("run", ("--mcap", "a.mcap", "--csv", "a.csv"), "--csv: give either --csv FILE or --mcap FILE"),
        ("run", (), "--csv: give --csv FILE or --mcap FILE"),
        ("run", ("--mcap", "a.mcap", "--kind", "x"), "--kind: 'x' works only with --csv"),
    ):
        assert export(Path(run), *flags) == 2
        error = capsys.readouterr().err
        assert error.startswith(f"loadgen export: {said}"), error
        assert error.count("\n") == 1
    assert sorted(Path().rglob("*")) == before
    assert Path("kept.mcap").read_text() == "kept"


@pytest.mark.parametrize("library", ["mcap", "rosbags"])
def test_a_missing_library_names_the_extra(tmp_path: Path, library: str) -> None:
    """The error is one line that says what to install, and a CSV file needs no such library."""
    drive(tmp_path)
    code = (
        f"import sys\nsys.modules[{library!r}] = None\n"
        "from offboard.loadgen.__main__ import main\n"
        "sys.exit(main(sys.argv[1:]))"
    )
    command = [sys.executable, "-c", code, "export", str(tmp_path), "--mcap", str(tmp_path / "a.mcap")]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=60)
    assert done.returncode == 2
    assert done.stderr == f"loadgen export: {needs('--mcap', 'mcap')}\n"
    assert not (tmp_path / "a.mcap").exists()


def test_a_file_that_is_not_finished_is_not_there(tmp_path: Path) -> None:
    """If an error ends the export in the middle, neither the file nor a part of it is left."""

    def fail(file: McapFile) -> None:
        file.write("/x", number(file.library, 1.0), 1)
        raise RuntimeError("in the middle")

    with pytest.raises(RuntimeError, match="in the middle"), new_mcap(tmp_path / "a.mcap") as file:
        fail(file)
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_one_error_and_leaves_nothing(tmp_path: Path) -> None:
    """If the file cannot grow any more, the error says so, and nothing is left of it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, hard))
    try:
        with (
            pytest.raises(ConfigError, match=r"a\.mcap cannot be written: File too large"),
            new_mcap(tmp_path / "a.mcap") as file,
        ):
            file.write("/x", number(file.library, 1.0), 1)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert list(tmp_path.iterdir()) == []
