"""Reads and writes plain files, and reads private ones, such as keys and the HTTP token.

A FIFO would stop the program, and a device or link must stay as it is. `keys` says what is in a key file.
"""

import contextlib
import errno
import os
import re
import stat
from pathlib import Path

from offboard.common.errors import ConfigError

_KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFLNK: "a symbolic link",
    stat.S_IFIFO: "a FIFO",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}
PRIVATE_BYTES_MAX = 64 * 1024
TOKEN_CHARS_MIN = 16

_TOKEN = re.compile(r"[A-Za-z0-9._~+/=-]+")  # the characters allowed after `Bearer` (RFC 6750)


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


def read_private(where: str, path: Path) -> str:
    """The text of a private file. ConfigError, starting with `where`, if other users may access it."""
    try:
        with path.open("rb") as file:
            mode = stat.S_IMODE(os.fstat(file.fileno()).st_mode)
            if mode & (stat.S_IRWXG | stat.S_IRWXO):
                raise ConfigError(
                    f"{where}: {path} has mode {mode:04o}, so other users may access it: chmod 600 {path}"
                )
            data = file.read(PRIVATE_BYTES_MAX + 1)
        if len(data) > PRIVATE_BYTES_MAX:
            raise ConfigError(f"{where}: {path} is larger than {PRIVATE_BYTES_MAX} bytes")
        return data.decode()
    except OSError as error:
        raise ConfigError(f"{where}: {path}: {error.strerror}") from error
    except UnicodeDecodeError:
        raise ConfigError(f"{where}: {path} is not a text file") from None


def read_token(path: Path | None) -> str | None:
    """The bearer token in the file of --token-file; None without a file."""
    if path is None:
        return None
    token = read_private("--token-file", path).strip()
    if len(token) < TOKEN_CHARS_MIN or not _TOKEN.fullmatch(token):
        raise ConfigError(
            f"--token-file: {path} must hold one token of at least {TOKEN_CHARS_MIN} characters; "
            "allowed are letters, digits and . _ ~ + / = -"
        )
    return token
