"""A real pseudo terminal: commands run in it, and files that write to it."""

import fcntl
import os
import pty
import re
import struct
import subprocess
import termios
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import TextIO

COLUMNS, ROWS = 100, 40
CODES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")
CHUNK_BYTES = 1 << 16


class Terminal:
    """Keeps what was written to its `file`, a terminal of 100 columns."""

    def __init__(self) -> None:
        self._reading, writing = pty.openpty()
        fcntl.ioctl(writing, termios.TIOCSWINSZ, struct.pack("HHHH", ROWS, COLUMNS, 0, 0))
        self.file: TextIO = os.fdopen(writing, "w")
        self._chunks: list[bytes] = []
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def close(self) -> str:
        """Everything that was written; nothing can be written any more."""
        self.file.close()
        self._reader.join()
        os.close(self._reading)
        return b"".join(self._chunks).decode()

    def _read(self) -> None:
        while True:
            try:
                chunk = os.read(self._reading, CHUNK_BYTES)
            except OSError:  # the last writer has closed the terminal
                return
            if not chunk:
                return
            self._chunks.append(chunk)


def run_in_terminal(
    command: Sequence[str], cwd: Path, *, timeout_s: float, stdout: int | None = None
) -> tuple[int, str, str]:
    """The exit code of the command, what the terminal got, and what went to `stdout` (PIPE) instead."""
    shown = Terminal()
    env = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "LINES", "NO_COLOR")}
    done = subprocess.run(
        command,
        stdin=subprocess.DEVNULL,
        stdout=shown.file if stdout is None else stdout,
        stderr=shown.file,
        env=env | {"TERM": "xterm-256color"},
        cwd=cwd,
        timeout=timeout_s,
        check=False,
    )
    return done.returncode, shown.close(), (done.stdout or b"").decode()


def plain_lines(text: str) -> list[str]:
    """The lines without escape codes; a line that was overwritten counts as several."""
    return [line for line in re.split(r"[\r\n]+", CODES.sub("", text)) if line.strip()]
