"""The trace: one JSON line for each task, written by a thread.

What a line says is in `record`; writing lines so that they survive a crash is left to `lines`.
"""

import atexit
import logging
import threading
import time
from collections import deque
from pathlib import Path

from offboard.common.errors import describe
from offboard.robot_client.records.lines import Lines
from offboard.robot_client.records.record import Record, as_dict

WRITE_EVERY_S = 0.5
WAITING_MAX = 1000  # records in memory
ROOM_WAIT_S, ROOM_POLL_S = 0.5, 0.001  # for which the first task without room waits for the disk
CLOSE_WAIT_S = 5.0  # that `close` waits for the disk

log = logging.getLogger(__name__)


class Trace(Lines):
    """Appends records to a file, in order. A record that cannot be written is lost and counted; tasks go on.

    A thread writes the waiting records every WRITE_EVERY_S. With a tenth of a CPU, writing between two tasks
    would delay the next one. A crash loses the waiting records. If WAITING_MAX of them wait for the disk,
    further ones are lost.
    """

    def __init__(self, path: Path) -> None:
        super().__init__("trace", path)
        self._waiting: deque[Record] = deque()
        self._stalled = False  # since a task waited for the disk in vain
        self._closing = False
        self._due = threading.Event()  # set if the thread must not wait any longer
        self._thread = threading.Thread(target=self._run, name="trace", daemon=True)
        self._thread.start()
        atexit.register(self.close)  # a program that does not close the trace loses no record

    def write(self, record: Record) -> None:
        """Add a record. Any thread may call this. After `close` nothing is added."""
        if self._closing:
            log.debug("trace %s: task %d ended after the run", self.path, record.i)
        elif len(self._waiting) < WAITING_MAX or self._has_room():
            self._waiting.append(record)
        else:
            self._lose(f"{WAITING_MAX} records wait for the disk")

    def close(self) -> None:
        """Write all waiting records and close the file, within CLOSE_WAIT_S. Safe to call twice."""
        atexit.unregister(self.close)
        if self._closing:
            return
        self._closing = True
        self._due.set()
        self._thread.join(CLOSE_WAIT_S)
        if self._thread.is_alive():
            self._lose(f"it is not written within {CLOSE_WAIT_S:g} s", len(self._waiting))

    def _has_room(self) -> bool:
        """Let the thread write, and wait until it has. After ROOM_WAIT_S the disk has stalled."""
        self._due.set()
        until_s = time.monotonic() + ROOM_WAIT_S
        while len(self._waiting) >= WAITING_MAX and not self._stalled:
            time.sleep(ROOM_POLL_S)
            if time.monotonic() > until_s:
                self._stalled = True
        return len(self._waiting) < WAITING_MAX

    def _run(self) -> None:
        last = False
        while not last:
            self._due.wait(WRITE_EVERY_S)
            self._due.clear()
            last = self._closing
            while self._waiting:
                self._write_first()
            self._stalled = False
        super().close()

    def _write_first(self) -> None:
        """Write the first waiting record, which waits, and counts, until it is written."""
        record = self._waiting[0]
        try:
            self.append(record.i, as_dict(record))
        except Exception as error:  # noqa: BLE001 - a policy of the user may decide anything
            self._lose(describe(error))
        self._waiting.popleft()
