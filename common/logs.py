"""How a process writes its log: from which level on, as text or as JSON, and how often the same line."""

import json
import logging
import math
from datetime import datetime, timezone

from offboard.common.token_bucket import Bucket

LEVELS = ("debug", "info", "warning", "error")
TEXT, JSON = "text", "json"
TEXT_LINE = "%(asctime)s %(levelname)s %(name)s: %(message)s"
TASK = "task"  # what the line of a task adds to its log record, with `extra`
PAUSE_S = 10.0  # between two lines of a RareLog


def start_log(level: str, form: str) -> None:
    """Write the log of this process to its standard error."""
    handler = logging.StreamHandler()
    handler.setFormatter(JsonLines() if form == JSON else logging.Formatter(TEXT_LINE))
    logging.basicConfig(level=level.upper(), handlers=[handler])


class JsonLines(logging.Formatter):
    """One JSON object per line: `time`, `level`, `logger`, `message`, and perhaps `task` and `traceback`."""

    def format(self, record: logging.LogRecord) -> str:
        fields = {
            "time": datetime.fromtimestamp(record.created, timezone.utc).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        if (task := getattr(record, TASK, None)) is not None:
            fields[TASK] = task
        if record.exc_info:
            fields["traceback"] = self.formatException(record.exc_info)
        return json.dumps(fields)


class RareLog:
    """Writes to `log`; once `most` lines are used up, one in PAUSE_S, which says that others are not logged.

    `name` goes in front of each line.
    """

    def __init__(self, log: logging.Logger, name: str = "", most: int = 1) -> None:
        self._log, self._name = log, name
        self._lines, self._at_s = Bucket(1 / PAUSE_S, most), -math.inf

    def __call__(self, level: int, text: str, now_s: float) -> None:
        """Write this text, which names a remedy, if it is its turn; `now_s` is a reading of any clock."""
        self._lines.fill(now_s - self._at_s)
        self._at_s = now_s
        if self._lines.level >= 1:
            self._lines.take(1)
            rest = "" if self._lines.level >= 1 else f" (others within {PAUSE_S:g} s are not logged)"
            self._log.log(level, f"{self._name}{text}{rest}")
