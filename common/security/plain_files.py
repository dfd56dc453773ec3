"""Writes to plain files only: a FIFO would stop the program, and a device or a link must stay what it is.

What is written, and when, is up to the callers. Every failure is an OSError.
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
