"""Only plain files are written to, renamed and replaced; FIFOs, devices, sockets, links and folders stay."""

import os
import socket
import stat
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from offboard.common.errors import ConfigError
from offboard.common.security.plain_files import check_plain, replace_file
from offboard.loadgen.table.measured_rows import write_whole
from offboard.robot_client.learning.store import Store
from offboard.robot_client.records.lines import Lines

SPECIAL = {
    "FIFO": "a FIFO",
    "device": "a device",
    "socket": "a socket",
    "folder": "a folder",
    "link to a device": "a symbolic link",
    "link to a file": "a symbolic link",
    "link to nothing": "a symbolic link",
}
# A trace is only appended to, so it may be behind a link. What is said of the file behind it:
BEHIND = {"link to a device": "is a device, not a plain file", "link to a file": "the file exists and is no "}


@pytest.fixture(params=SPECIAL)
def special(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[str, Path]]:
    """The name and the path of something that is no plain file; it must be the same after the test."""
    name, path, target = request.param, tmp_path / "special", tmp_path / "target"
    target.write_text("precious")
    match name:
        case "FIFO":
            os.mkfifo(path)
        case "device":
            make_device(path)
        case "socket":
            with socket.socket(socket.AF_UNIX) as one:
                one.bind(str(path))
        case "folder":
            path.mkdir()
        case "link to a device":
            path.symlink_to("/dev/null")
        case "link to a file":
            path.symlink_to(target)
        case _:
            path.symlink_to(tmp_path / "nothing")
    before = path.lstat()
    yield name, path
    after = path.lstat()
    assert (after.st_ino, after.st_mode) == (before.st_ino, before.st_mode)
    assert target.read_text() == "precious"
    assert stat.S_ISCHR(Path("/dev/null").stat().st_mode)
    assert not path.with_name("special.unreadable").exists()


def make_device(path: Path) -> None:
    """A node for /dev/null, which only root can make."""
    try:
        os.mknod(path, stat.S_IFCHR | 0o666, os.makedev(1, 3))
    except PermissionError:
        pytest.skip("only root can make a device node")


@pytest.mark.parametrize("write", [Store, lambda path: write_whole(path, "new")], ids=["memory", "dataset"])
def test_only_a_plain_file_is_replaced(write: Callable[[Path], object], special: tuple[str, Path]) -> None:
    """The error at the start says what the path is, and nothing waits for the other end of a FIFO."""
    name, path = special
    with pytest.raises(ConfigError, match=f"{path}: .*is {SPECIAL[name]}, not a plain file"):
        write(path)


def test_a_trace_is_appended_to_plain_files_only(special: tuple[str, Path]) -> None:
    """The error at the start says what the path is. The file behind a link must be a trace, or new."""
    name, path = special
    if name == "link to nothing":
        Lines("trace", path).close()
        assert path.is_file()
        return
    said = BEHIND.get(name, f"is {SPECIAL[name]}, not a plain file")
    with pytest.raises(ConfigError, match=f"trace {path}: {said}"):
        Lines("trace", path)


def test_a_file_that_is_exchanged_while_tasks_run_is_not_replaced(special: tuple[str, Path]) -> None:
    """What takes the place of a file later is not replaced either."""
    _, path = special
    with pytest.raises(OSError, match="not a plain file"):
        replace_file(path, b"new")


def test_a_link_in_place_of_the_temporary_file_is_not_followed(tmp_path: Path) -> None:
    """The target of the link keeps its content, and the file is written."""
    (tmp_path / "target").write_text("precious")
    (tmp_path / ".memory.json.new").symlink_to(tmp_path / "target")
    replace_file(tmp_path / "memory.json", b"new")
    assert (tmp_path / "target").read_text() == "precious"
    assert (tmp_path / "memory.json").read_bytes() == b"new"
    assert not (tmp_path / "memory.json").is_symlink()


def test_a_link_to_a_file_that_was_set_aside_stays(tmp_path: Path) -> None:
    """An unreadable memory file does not take the place of a link that leads nowhere."""
    path, aside = tmp_path / "memory.json", tmp_path / "memory.json.unreadable"
    path.write_text("not a memory")
    aside.symlink_to(tmp_path / "nothing")
    Store(path)
    assert aside.is_symlink()
    assert path.read_text() == "not a memory"


def test_plain_files_and_free_paths_are_fine(tmp_path: Path) -> None:
    """A link to a plain file is fine only where it was asked for."""
    (tmp_path / "plain").touch()
    (tmp_path / "link").symlink_to("plain")
    check_plain(tmp_path / "plain")
    check_plain(tmp_path / "free")
    check_plain(tmp_path / "link", link=True)
    with pytest.raises(OSError, match="is a symbolic link"):
        check_plain(tmp_path / "link")
