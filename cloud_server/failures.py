"""What the server remembers of requests that failed: the workers that they cost, and what was logged."""

import logging
from collections import OrderedDict

from offboard.cloud_server.executors.executor import Outcome

CRASHES_MAX = 3  # workers that one request may cost
CRASHED_KEPT = 1024  # requests whose crashes are remembered
FAILURES_KEPT = 256  # kinds and types of errors that are logged: a task may make types without limit

log = logging.getLogger("offboard.cloud_server")


class CrashCount:
    """How many workers each request has cost, for the last CRASHED_KEPT requests that cost one."""

    def __init__(self) -> None:
        self._counts: OrderedDict[tuple[bytes, int], int] = OrderedDict()

    def note(self, peer: bytes, id: int) -> None:
        self._counts[peer, id] = self._counts.pop((peer, id), 0) + 1
        if len(self._counts) > CRASHED_KEPT:
            self._counts.popitem(last=False)

    def too_many(self, peer: bytes, id: int) -> bool:
        return self._counts.get((peer, id), 0) >= CRASHES_MAX


class FailureLog:
    """Logs the traceback of a failing task, once for each kind and type of error."""

    def __init__(self) -> None:
        self._logged: set[tuple[str, str]] = set()

    def note(self, kind: str, outcome: Outcome) -> None:
        failure = kind, outcome.error.partition(":")[0]
        if not outcome.traceback or failure in self._logged or len(self._logged) == FAILURES_KEPT:
            return
        self._logged.add(failure)
        log.warning(
            "task %s failed; its next failures with %s are not logged; remedy: correct the task\n%s",
            *failure,
            outcome.traceback.rstrip(),
        )

    def say(self, kind: str, note: str) -> None:
        """Log what a run of several requests noted, once for each kind."""
        said = kind, ""
        if note and said not in self._logged and len(self._logged) < FAILURES_KEPT:
            self._logged.add(said)
            log.warning("task %s: %s; not logged again; remedy: correct the task", kind, note)
