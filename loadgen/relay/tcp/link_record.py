"""The record of what the link really did, as JSON Lines; docs/formats.md describes the lines.

A thread writes the lines, so that a slow disk does not delay the bytes on the link.
"""

import json
import logging
import threading
from pathlib import Path
from typing import Any

from offboard.common.errors import ConfigError
from offboard.loadgen.relay.link.link import Link
from offboard.loadgen.relay.link.pipe import Pipe

WAITING_BYTES_MAX = 16 << 20  # text that waits to be written; lines beyond it are dropped and counted
WRITE_S = 0.1  # between two writes
CLOSE_S = 5.0  # time for the last write

log = logging.getLogger(__name__)


class LinkRecord:
    """Writes lines to `path`, soon after they are added; an earlier file is replaced.

    All times are of one monotonic clock; a line holds the seconds since `start_s`.
    """

    def __init__(self, path: Path, start_s: float) -> None:
        try:
            self._file = path.open("wb", buffering=0)  # a buffer would retry what a full disk refused
        except OSError as error:
            raise ConfigError(f"--truth: cannot write {path}: {error.strerror}") from error
        self._start_s = self._end_s = start_s
        self._lock = threading.Lock()
        self._waiting: list[str] = []
        self._waiting_bytes = 0
        self._ending = threading.Event()
        self._broken = False
        self.lines = 0
        self.dropped = 0
        self._thread = threading.Thread(target=self._write_all, name="link-record", daemon=True)
        self._thread.start()

    def conditions(self, now_s: float, by: str, link: Link) -> None:
        """The conditions at the start (by "flag"), or after a change (by "http" or "schedule")."""
        self._add(self._event("conditions", now_s, by=by, up=link.up.shown(), down=link.down.shown()))

    def opened(self, now_s: float, connection: int) -> None:
        self._add(self._event("opened", now_s, connection=connection))

    def closed(self, now_s: float, connection: int, how: str) -> None:
        self._add(self._event("closed", now_s, connection=connection, how=how))

    def chunk(
        self, number: int, way: str, pipe: Pipe, *, segment: int, size: int, arrived_s: float, due_s: float
    ) -> str:
        """The start of the line of a chunk, which `pipe` has just taken for connection `number`.

        Pass it to `delivered` when the chunk was delivered or lost.
        """
        return (
            f'{{"what": "chunk", "connection": {number}, "direction": "{way}", '
            f'"segment": {segment}, "bytes": {size}, '
            f'"arrived_s": {arrived_s - self._start_s:.6f}, '
            f'"drawn_ms": {pipe.drawn_ms:.6f}, "stall_ms": {pipe.stall_ms:.6f}, '
            f'"due_s": {due_s - self._start_s:.6f}, "delivered_s": '
        )

    def delivered(self, chunk: str, now_s: float | None) -> None:
        """Add the line of a chunk, with the time of its delivery; None means that it was lost."""
        self._add(chunk + ("null}\n" if now_s is None else f"{now_s - self._start_s:.6f}}}\n"))

    def status(self) -> dict[str, int]:
        return {"lines": self.lines, "dropped": self.dropped}

    def close(self, now_s: float) -> None:
        """Write the lines that wait, and a last line with the counts."""
        self._end_s = now_s
        self._ending.set()
        self._thread.join(CLOSE_S)
        if self._thread.is_alive():
            log.warning(
                "the record of the link was not written within %g s: its end is missing; "
                "remedy: use a faster disk",
                CLOSE_S,
            )

    def _event(self, what: str, now_s: float, **more: Any) -> str:
        return json.dumps({"what": what, "at_s": round(now_s - self._start_s, 6), **more}) + "\n"

    def _add(self, line: str) -> None:
        with self._lock:
            if self._broken or self._waiting_bytes + len(line) > WAITING_BYTES_MAX:
                self.dropped += 1
            else:
                self._waiting.append(line)
                self._waiting_bytes += len(line)
                self.lines += 1

    def _write_all(self) -> None:
        """The thread: write all lines that wait, again and again; after `close` once more, then end."""
        ending = False
        with self._file:
            while not ending:
                ending = self._ending.wait(WRITE_S)
                with self._lock:
                    lines, self._waiting = self._waiting, []
                if not self._write("".join(lines)):
                    with self._lock:
                        self.lines, self.dropped = self.lines - len(lines), self.dropped + len(lines)
            self._write(self._event("end", self._end_s, **self.status()))

    def _write(self, text: str) -> bool:
        """Write this text, and return whether it was written; after a failure nothing is written."""
        left = memoryview(text.encode("ascii"))
        try:
            while left and not self._broken:
                left = left[self._file.write(left) :]
        except OSError as error:
            text = "cannot write the record of the link: %s; later lines are dropped; remedy: free its disk"
            log.warning(text, error.strerror)
            self._broken = True
        with self._lock:
            self._waiting_bytes -= len(text)
        return not self._broken
