"""What `/diagnostics` says of the offloader: the last decision, predicted and true times, and the link.

`node` publishes it.
"""

import threading
from collections import Counter, deque

from offboard.common.text.wording import duration
from offboard.robot_client.policies import Outlook
from offboard.robot_client.records.record import Record
from offboard.robot_client.sites.runner import ONBOARD

SHARE_TASKS = 100  # the share of each site is that of the last tasks
OK, WARN = 0, 1  # levels of diagnostic_msgs/DiagnosticStatus


class Diagnostics:
    """An observer of an offloader that sums up its last tasks."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._last: Record | None = None
        self._used: deque[str] = deque(maxlen=SHARE_TASKS)

    def __call__(self, record: Record) -> None:
        with self._lock:
            self._last = record
            self._used.append(record.used or "none")

    def level(self) -> int:
        """WARN while a server gives no answer, or if nothing answered the last task."""
        last = self._last
        if last is None:
            return OK
        silent = any(one.condition.silent for site, one in last.sites.items() if site != ONBOARD)
        return WARN if silent or last.used is None else OK

    def summary(self) -> str:
        """One line: where the last task ran, and how long it took."""
        last = self._last
        return "no task yet" if last is None else f"{last.used or 'no site'}: {duration(last.waited_s)}"

    def values(self) -> dict[str, str]:
        """The facts by name; times in milliseconds."""
        with self._lock:
            last, used = self._last, Counter(self._used)
        if last is None:
            return {}
        found = {
            "site": last.used or "none",
            "reason": last.decision.reason,
            "policy": last.decision.policy,
            "waited_ms": f"{last.waited_s * 1e3:.3f}",
        }
        for site, outlook in last.sites.items():
            found |= _of_site(site, outlook)
        found |= {f"{run.site}.true_ms": f"{run.seconds * 1e3:.3f}" for run in last.executions if run.ok}
        total = used.total()
        return found | {f"{site}.share": f"{used[site] / total:.2f}" for site in last.sites}


def _of_site(site: str, outlook: Outlook) -> dict[str, str]:
    condition, found = outlook.condition, {}
    if outlook.predicted_s is not None:
        found[f"{site}.predicted_ms"] = f"{outlook.predicted_s * 1e3:.3f}"
    if site != ONBOARD:
        found[f"{site}.link"] = "silent" if condition.silent else "answers"
        if condition.round_trip_s is not None:
            found[f"{site}.round_trip_ms"] = f"{condition.round_trip_s * 1e3:.3f}"
    return found
