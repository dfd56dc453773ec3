"""How a process writes its log: from which level on, and as text or as JSON.

What is logged is left to each module.
"""

import json
import logging
from datetime import UTC, datetime

LEVELS = ("debug", "info", "warning", "error")
TEXT, JSON = "text", "json"
TEXT_LINE = "%(asctime)s %(levelname)s %(name)s: %(message)s"
TASK = "task"  # what the line of a task adds to its log record, with `extra`


def start_log(level: str, form: str) -> None:
    """Write the log of this process to its standard error."""
    handler = logging.StreamHandler()
    handler.setFormatter(JsonLines() if form == JSON else logging.Formatter(TEXT_LINE))
    logging.basicConfig(level=level.upper(), handlers=[handler])


class JsonLines(logging.Formatter):
    """One JSON object per line: `time`, `level`, `logger`, `message`, and perhaps `task` and `traceback`."""

    def format(self, record: logging.LogRecord) -> str:
        fields = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        if (task := getattr(record, TASK, None)) is not None:
            fields[TASK] = task
        if record.exc_info:
            fields["traceback"] = self.formatException(record.exc_info)
        return json.dumps(fields)
