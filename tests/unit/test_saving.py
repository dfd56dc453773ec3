"""When the memory file is written, and what happens if the disk is slow, full or gone."""

import json
import logging
import os
import threading
from pathlib import Path

import pytest

from offboard.common.errors import ConfigError
from offboard.common.security import plain_files
from offboard.robot_client.learning import store
from offboard.robot_client.learning.store import SAVE_EVERY_S, Store
from offboard.robot_client.sites.runner import CLOUD
from tests.memory_robot import Robot, store_plain


@pytest.fixture
def robot(tmp_path: Path) -> Robot:
    return Robot(tmp_path)


def test_a_kill_while_writing_leaves_the_previous_file(robot: Robot) -> None:
    """The torn half is in a temporary file, which is never read and which the next save replaces."""
    with robot.started() as offload:
        robot.ask(offload, 60)
    torn = robot.path.with_name(".memory.json.new")
    torn.write_bytes(robot.path.read_bytes()[:1000])
    with robot.started() as offload:
        assert robot.outlooks(offload)[CLOUD].observations == 50
    assert not torn.exists()
    assert sorted(one.name for one in robot.path.parent.iterdir()) == ["memory.json"]


def test_a_save_survives_a_loss_of_power(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    """The new file is on the disk before it is renamed, and the new name is before the save ends."""
    sync, synced = os.fsync, []

    def note(number: int) -> None:
        synced.append((Path(f"/proc/self/fd/{number}").readlink().name, robot.path.exists()))
        sync(number)

    monkeypatch.setattr(plain_files.os, "fsync", note)
    robot.started().close()
    assert synced == [(".memory.json.new", False), (robot.path.parent.name, True)]


def writers() -> list[threading.Thread]:
    """The threads that write a memory file now."""
    return [thread for thread in threading.enumerate() if thread.name == "memory"]


def wait_for_writers() -> None:
    for writer in writers():
        writer.join(10)


def test_the_memory_is_saved_every_half_minute(robot: Robot) -> None:
    """It is first saved SAVE_EVERY_S after the first task, so a crash costs half a minute of learning."""
    offload = robot.started()
    robot.ask(offload, 5)
    assert not robot.path.exists()
    for observations in (6, 7):
        robot.clock.wait([], SAVE_EVERY_S)
        robot.ask(offload, 1)
        wait_for_writers()
        sites = json.loads(robot.path.read_bytes())["kinds"]["store_plain"]["sites"]
        assert len(sites[CLOUD]["observations"]) == observations
        robot.ask(offload, 0)
    offload.close()


def test_a_slow_disk_delays_no_task(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    """While a save hangs, tasks are answered and no second save starts; `close` writes the last state."""
    hanging, entered = threading.Event(), threading.Event()
    sync = plain_files.os.fsync

    def slow(number: int) -> None:
        entered.set()
        assert hanging.wait(10)
        sync(number)

    monkeypatch.setattr(plain_files.os, "fsync", slow)
    offload = robot.started()
    robot.ask(offload, 1)
    robot.clock.wait([], SAVE_EVERY_S)
    robot.ask(offload, 1)
    assert entered.wait(10)
    (writer,) = writers()
    for _ in range(3):
        robot.clock.wait([], SAVE_EVERY_S)
        robot.ask(offload, 1)
        assert writers() == [writer]
    hanging.set()
    offload.close()
    sites = json.loads(robot.path.read_bytes())["kinds"]["store_plain"]["sites"]
    assert len(sites[CLOUD]["observations"]) == 5


def test_close_does_not_wait_forever_for_a_disk(
    robot: Robot, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """`close` waits WRITE_WAIT_S at most, and logs that the file was not written."""
    hanging = threading.Event()
    monkeypatch.setattr(plain_files.os, "fsync", lambda _: hanging.wait(10) and None)
    monkeypatch.setattr(store, "WRITE_WAIT_S", 0.01)
    offload = robot.started()
    robot.ask(offload, 1)
    offload.close()
    assert "not written within 0.01 s" in caplog.text
    hanging.set()
    wait_for_writers()


def test_a_failing_disk_gives_one_warning_and_costs_no_answer(
    robot: Robot, caplog: pytest.LogCaptureFixture
) -> None:
    """Tasks go on while the file cannot be written, and it is written again when the disk works."""
    blocked = robot.path.with_name(".memory.json.new")
    blocked.mkdir()
    offload = robot.started()
    for _ in range(4):
        robot.clock.wait([], SAVE_EVERY_S)
        assert offload(store_plain, 2.0) == 2.0
        wait_for_writers()
    assert [one.getMessage() for one in caplog.records if one.levelno == logging.WARNING] == [
        f"memory {robot.path} cannot be written: Is a directory; remedy: use another file"
    ]
    blocked.rmdir()
    offload.close()
    assert robot.path.exists()


def test_a_save_without_a_free_thread_costs_no_answer(
    robot: Robot, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """If no thread can be started, the file is not written, and one warning says so."""

    def refuse(_: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    offload = robot.started()
    offload(store_plain, 2.0)
    monkeypatch.setattr(store.threading.Thread, "start", refuse)
    for _ in range(3):
        robot.clock.wait([], SAVE_EVERY_S)
        assert offload(store_plain, 2.0) == 2.0
    offload.close()
    assert caplog.text.count("can't start new thread") == 1


def test_nothing_is_saved_after_close(robot: Robot) -> None:
    """A second `close`, and tasks that end later, do not change the file."""
    offload = robot.started()
    robot.ask(offload, 3)
    offload.close()
    written = robot.path.stat().st_mtime_ns
    robot.clock.wait([], 10 * SAVE_EVERY_S)
    robot.ask(offload, 3)
    offload.close()
    assert robot.path.stat().st_mtime_ns == written


def test_the_path_of_a_folder_is_a_config_error(tmp_path: Path) -> None:
    """A wrong path is an error at the start; missing folders are created."""
    with pytest.raises(ConfigError, match=f"memory {tmp_path}: is a folder"):
        Store(tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match=r"memory .*: File exists|Not a directory"):
        Store(tmp_path / "file" / "memory.json")
    Store(tmp_path / "a" / "b" / "memory.json")
    assert (tmp_path / "a" / "b").is_dir()
