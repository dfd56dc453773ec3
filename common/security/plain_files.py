"""Reads and writes plain files only: a FIFO would stop the program, and a device or link must stay as it is.

What is read and written, and when, is up to the callers. Every failure is an OSError.
"""

import contextlib
import errno
import os
import stat
from pathlib import Path

_KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFLNK: "a symbolic link",
    stat.S_IFIFO: "a FIFO",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


def check_plain(path: Path, *, link: bool = False) -> None:
    """OSError if `path` is there and no plain file. With `link`, it may also be a link to a plain file."""
    try:
        mode = path.stat(follow_symlinks=link).st_mode
    except FileNotFoundError:
        return
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, f"is {_KINDS[stat.S_IFMT(mode)]}, not a plain file")


def read_plain(path: Path, bytes_max: int) -> bytes:
    """The first bytes of a plain file, or of a link to one."""
    check_plain(path, link=True)
    with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK), "rb") as file:  # it may have become a FIFO
        return file.read(bytes_max)


def replace_file(path: Path, data: bytes) -> None:
    """Replace a file in one step: a reader, also after a crash, finds the whole old or the whole new file."""
    check_plain(path)
    fresh = path.with_name(f".{path.name}.new")
    try:
        fresh.unlink(missing_ok=True)
        with fresh.open("xb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        fresh.replace(path)
    except OSError:
        with contextlib.suppress(OSError):
            fresh.unlink(missing_ok=True)
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
