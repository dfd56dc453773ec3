"""JSON Lines files that a run appends to, and that survive its crash.

The fields of a line are left to its owner, such as `trace`.
"""

import contextlib
import errno
import json
import logging
import os
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from offboard.common.errors import ConfigError
from offboard.common.security.plain_files import check_plain

VERSION = 1
LINE_START = b'{"v":'

_ENCODE = json.JSONEncoder(separators=(",", ":")).encode

log = logging.getLogger(__name__)


class Lines:
    """Appends lines to a file without a buffer, from any thread.

    A line that cannot be written is counted in `lost`, and the first one is logged; tasks go on.

    what: the kind of file, for messages.
    """

    def __init__(self, what: str, path: Path) -> None:
        self.path = path
        self.lost = 0
        self._what = what
        self._lock = threading.Lock()
        self._counting = threading.Lock()  # apart, as a stalled disk keeps the other one
        try:
            check_plain(path, link=True)
            path.parent.mkdir(parents=True, exist_ok=True)
            if path.exists():
                self._cut_torn_line()
            self._file = path.open("ab", buffering=0)
        except OSError as error:
            raise ConfigError(f"{what} {path}: {error.strerror}") from error

    def append(self, number: int, fields: Mapping[str, Any]) -> None:
        """Append the line of task `number`, whose first field is `v`. After `close` nothing is written."""
        line = _ENCODE(fields).encode() + b"\n"
        with self._lock:
            if self._file.closed:
                log.debug("%s %s: task %d ended after the run", self._what, self.path, number)
                return
            end = os.fstat(self._file.fileno()).st_size
            try:
                if self._file.write(line) < len(line):  # a full disk may take a part of the line
                    raise OSError(errno.ENOSPC, "no space left for the whole line")
            except OSError as error:
                self._lose(error.strerror)
                with contextlib.suppress(OSError):
                    os.truncate(self._file.fileno(), end)

    def close(self) -> None:
        with self._lock:
            self._file.close()

    def _lose(self, why: str | None, count: int = 1) -> None:
        """Count lines that are lost, and log the first loss of this file."""
        with self._counting:
            first, self.lost = not self.lost, self.lost + count
        if first:
            text = "%s %s: a line is lost: %s; others are only counted; remedy: free the disk"
            log.error(text, self._what, self.path, why)

    def _cut_torn_line(self) -> None:
        """Remove half a line that a crash has left. A file of another kind is never changed."""
        with self.path.open("rb") as file:
            start = file.read(len(LINE_START))
        if not LINE_START.startswith(start):
            raise ConfigError(f"{self._what} {self.path}: the file exists and is no {self._what}")
        kept = _end_of_last_line(self.path)
        if kept < self.path.stat().st_size:
            text = "%s %s: cut off a torn last line; remedy: none, a crash had torn it"
            log.warning(text, self._what, self.path)
            os.truncate(self.path, kept)


def _end_of_last_line(path: Path) -> int:
    """The number of bytes up to the last newline, including it. Reads only the end of the file."""
    with path.open("rb") as file:
        end = file.seek(0, os.SEEK_END)
        while end > 0:
            start = max(0, end - 65536)
            file.seek(start)
            at = file.read(end - start).rfind(b"\n")
            if at >= 0:
                return start + at + 1
            end = start
    return 0
