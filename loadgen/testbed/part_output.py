"""The output of a part, written to a log or to our stdout while the part runs.

`docker_testbed` attaches to a container; `part_process` reads the pipe of a process.
"""

import codecs
import contextlib
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

TAIL_LINES = 15
TAIL_BYTES = 1 << 16
END_S = 5.0  # longest wait for the last output of a part that has ended


class Output(threading.Thread):
    """Copies `chunks` until they end: to the file `log`, or to our stdout if `log` is None.

    `again` appends to an existing log instead of replacing it.
    """

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
            with contextlib.suppress(OSError, ValueError):  # after a full disk or a closed stdout, read on
                if self.log is None:
                    sys.stdout.write(text.decode(chunk))
                    sys.stdout.flush()
                else:
                    with self.log.open("ab") as file:
                        file.write(chunk)

    def finish(self) -> None:
        """Wait for the last output of a part that has ended, at most END_S."""
        self.join(END_S)

    def tail(self) -> str:
        """The last lines of the output."""
        lines = self._last.decode(errors="replace").splitlines()
        return "\n".join(lines[-TAIL_LINES:]) or "(it logged nothing)"
