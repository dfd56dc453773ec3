"""The relay's record of what its link really did, as JSON Lines: docs/formats.md says what is in them.

Lines are kept in memory and written by a thread, so that a slow disk does not delay the bytes on the link.
"""

import json
import logging
import threading
from pathlib import Path
from typing import Any

from offboard.common.errors import ConfigError
from offboard.loadgen.relay.link.link import Link, Pipe

WAITING_BYTES_MAX = 16 << 20  # text not written yet; what comes beyond it is dropped and counted
WRITE_S = 0.1  # between two writes
CLOSE_S = 5.0  # what the last write may take

log = logging.getLogger(__name__)


class Truth:
    """Takes lines at any time, writes them to `path` soon; an earlier file is replaced.

    All times given are of one monotonic clock, `start_s` among them; those written are seconds since then.
    """

    def __init__(self, path: Path, start_s: float) -> None:
        try:
            self._file = path.open("wb", buffering=0)  # what a full disk refused must not come again
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
        self._thread = threading.Thread(target=self._write_all, name="truth", daemon=True)
        self._thread.start()

    def conditions(self, now_s: float, by: str, link: Link) -> None:
        """The link was changed, or is so from the start, by flag, http or schedule."""
        self._add(self._event("conditions", now_s, by=by, up=link.up.shown(), down=link.down.shown()))

    def opened(self, now_s: float, connection: int) -> None:
        self._add(self._event("opened", now_s, connection=connection))

    def closed(self, now_s: float, connection: int, how: str) -> None:
        self._add(self._event("closed", now_s, connection=connection, how=how))

    def chunk(
        self,
        connection: int,
        direction: str,
        segment: int,
        size: int,
        arrived_s: float,
        due_s: float,
        pipe: Pipe,
    ) -> str:
        """A chunk that just went into `pipe`; give the text to `delivered` when its fate is known."""
        return (
            f'{{"what": "chunk", "connection": {connection}, "direction": "{direction}", '
            f'"segment": {segment}, "bytes": {size}, "arrived_s": {arrived_s - self._start_s:.6f}, '
            f'"drawn_ms": {pipe.drawn_ms:.6f}, "stall_ms": {pipe.stall_ms:.6f}, '
            f'"due_s": {due_s - self._start_s:.6f}, "delivered_s": '
        )

    def delivered(self, chunk: str, now_s: float | None) -> None:
        """When a chunk was delivered, None where it never will be."""
        self._add(chunk + ("null}\n" if now_s is None else f"{now_s - self._start_s:.6f}}}\n"))

    def status(self) -> dict[str, int]:
        return {"lines": self.lines, "dropped": self.dropped}

    def close(self, now_s: float) -> None:
        """Write what waits, and a last line with the counts."""
        self._end_s = now_s
        self._ending.set()
        self._thread.join(CLOSE_S)
        if self._thread.is_alive():
            log.warning("the truth is not written after %g s: its end is missing", CLOSE_S)

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
        """The thread: all that waits, again and again; once more after `close`, then the end."""
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
        """Whether it was written; after the first failure nothing is."""
        left = memoryview(text.encode("ascii"))
        try:
            while left and not self._broken:
                left = left[self._file.write(left) :]
        except OSError as error:
            log.warning("cannot write the truth: %s; the rest is dropped", error.strerror)
            self._broken = True
        with self._lock:
            self._waiting_bytes -= len(text)
        return not self._broken
