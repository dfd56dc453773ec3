"""What a container says, kept or shown while it runs; where it comes from is the business of `containers`."""

import codecs
import contextlib
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

from offboard.loadgen.testbed.part import TAIL_BYTES, TAIL_LINES

END_S = 5.0  # from the end of a container to the last of its output


class Output(threading.Thread):
    """Reads `chunks` to their end: to our stdout, or to `log`, which begins anew unless `again`."""

    def __init__(self, name: str, chunks: Iterator[bytes], log: Path | None, *, again: bool = False) -> None:
        super().__init__(name=f"output of {name}", daemon=True)
        self.log = log
        self._chunks = chunks
        self._last = b""
        if log is not None:
            log.parent.mkdir(parents=True, exist_ok=True)
            log.open("ab" if again else "wb").close()

    def run(self) -> None:
        text = codecs.getincrementaldecoder("utf-8")("replace")
        for chunk in self._chunks:
            self._last = (self._last + chunk)[-TAIL_BYTES:]
            with contextlib.suppress(OSError, ValueError):  # a full disk, a closed stdout: read on
                if self.log is None:
                    sys.stdout.write(text.decode(chunk))
                    sys.stdout.flush()
                else:
                    with self.log.open("ab") as file:
                        file.write(chunk)

    def finish(self) -> None:
        """Wait for the rest of a container that has ended, for a bounded time."""
        self.join(END_S)

    def tail(self) -> str:
        """The last lines."""
        lines = self._last.decode(errors="replace").splitlines()
        return "\n".join(lines[-TAIL_LINES:]) or "(it logged nothing)"
