"""Reads files that only their owner may read: private keys and the HTTP token.

`keys` says what is in a key file.
"""

import os
import re
import stat
from pathlib import Path

from offboard.common.errors import ConfigError

PRIVATE_BYTES_MAX = 64 * 1024
TOKEN_CHARS_MIN = 16

_TOKEN = re.compile(r"[A-Za-z0-9._~+/=-]+")  # the characters allowed after `Bearer` (RFC 6750)


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
