"""Which task of a batch starts next, and where, so that the last one ends soonest.

This is list scheduling by earliest predicted finish, the longest task first (Graham 1969, Bounds on
Multiprocessing Timing Anomalies). It is repeated whenever a task has ended: only tasks that can start now are
placed. There is no clock here; `batch` runs the tasks.
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from offboard.robot_client.sites.runner import ONBOARD

SERVER_IN_FLIGHT = 2  # one task runs while the next one is on its way
SERVER_IN_FLIGHT_MAX = 8
ONBOARD_IN_FLIGHT = 1  # onboard runs one task at a time, and no task is on its way
QUEUED, UNQUEUED = 1.0, 0.1  # wait for a worker over run time: above, fewer tasks at once; below, more
PACE_MIN = 0.1
OVERDUE = 0.1  # of its predicted time: an overdue task should still need at least this long


@dataclass(slots=True)
class Queue:
    """The tasks of a batch on one site, in the order of their start.

    `within_s`: a task that would end later than this is not added to other tasks.
    `lost_s`: what the quality that the site loses is worth; another site may end a task later by this much.
    The pace of a site is the predicted time that it works off in one second. It is above 1 if the site runs
    several tasks at once, or if tasks travel while others run.
    """

    site: str
    within_s: float
    lost_s: float = 0.0
    limit: int = 0
    running: dict[int, float] = field(
        default_factory=dict
    )  # predicted seconds by task, in the order of start
    _since_s: float = 0.0  # when the first running task got its turn
    _done_s: float = 0.0  # predicted seconds of the tasks that ended
    _busy_s: float = 0.0

    def __post_init__(self) -> None:
        self.limit = ONBOARD_IN_FLIGHT if self.site == ONBOARD else SERVER_IN_FLIGHT

    def start(self, task: int, seconds: float, now_s: float) -> None:
        if not self.running:
            self._since_s = now_s
        self.running[task] = seconds

    def end(self, task: int, now_s: float) -> None:
        """The task was answered, on this site or another one."""
        self._done_s += self.running.pop(task)
        self._busy_s += now_s - self._since_s
        self._since_s = now_s

    def hear(self, queue_s: float | None, run_s: float | None) -> None:
        """Adapt the limit to how long an answered task waited for a worker, and ran; None if it failed."""
        if self.site == ONBOARD:
            return
        if queue_s is None or run_s is None:
            self.limit = 1
        elif queue_s > QUEUED * run_s:
            self.limit = max(SERVER_IN_FLIGHT, self.limit - 1)
        elif queue_s <= UNQUEUED * run_s and len(self.running) >= self.limit - 1:
            self.limit = min(SERVER_IN_FLIGHT_MAX, self.limit + 1)

    def can_begin(self, seconds: float, now_s: float) -> bool:
        if not self.running:
            return True
        return len(self.running) < self.limit and self.finish_s(seconds, now_s) <= self.within_s

    def finish_s(self, seconds: float, now_s: float, behind_s: float = 0.0) -> float:
        """How many seconds from now one more task would end; it is predicted to take `seconds`.

        `behind_s`: predicted seconds of other tasks that would run before it.
        """
        left_s = self._left_s(len(self.running), now_s)
        return max(seconds, (left_s + behind_s + seconds) / self._pace(seconds))

    def end_s(self, task: int, now_s: float) -> float:
        """How many seconds from now a task that runs here should end."""
        place = list(self.running).index(task) + 1
        return self._left_s(place, now_s) / self._pace(self.running[task])

    def _left_s(self, count: int, now_s: float) -> float:
        """Predicted seconds that the first `count` tasks still need.

        An overdue task should need as long again as it is late already: the reason is not known.
        """
        if not self.running:
            return 0.0
        first, *others = list(self.running.values())[:count]
        done_s = (now_s - self._since_s) * self._pace(first)
        return max(first - done_s, done_s - first, OVERDUE * first) + sum(others)

    def _pace(self, seconds: float) -> float:
        """The pace, with one more task counted as if it took what was predicted."""
        if self._busy_s + seconds <= 0:
            return 1.0
        return max(PACE_MIN, (self._done_s + seconds) / (self._busy_s + seconds))


@dataclass(frozen=True, slots=True)
class Start:
    """The waiting task that starts now: its place, its site, and the seconds until each site would end it."""

    place: int
    site: str
    finish_s: Mapping[str, float]


def next_start(
    predicted: Iterable[Mapping[str, float]], queues: Mapping[str, Queue], now_s: float
) -> Start | None:
    """The first task that should end earliest on a site where it can start now.

    `predicted` gives the seconds by site of each waiting task, the longest task first; it is only read as far
    as needed. A task that would end earlier on a busy site waits for that site, and the tasks after it take
    that into account.
    """
    behind_s: defaultdict[str, float] = defaultdict(float)  # reading `predicted` may bring sites
    for place, seconds in enumerate(predicted):
        finish_s = {site: queues[site].finish_s(one, now_s, behind_s[site]) for site, one in seconds.items()}
        if not finish_s:
            continue
        best = min(finish_s, key=lambda site: (finish_s[site] + queues[site].lost_s, site != ONBOARD))
        if queues[best].can_begin(seconds[best], now_s):
            return Start(place, best, finish_s)
        behind_s[best] += seconds[best]
    return None


def takeover(
    predicted: Mapping[int, Mapping[str, float]], queues: Mapping[str, Queue], now_s: float
) -> tuple[int, str] | None:
    """The running task for which an idle site would save most, and that site; None if no site would.

    `predicted` holds the seconds by site of the tasks that may run twice.
    """
    saved_s: dict[tuple[int, str], float] = {}
    for idle in (queue for queue in queues.values() if not queue.running):
        for queue in queues.values():
            for task in queue.running.keys() & predicted.keys():
                if idle.site in predicted[task]:
                    here_s = predicted[task][idle.site] + idle.lost_s
                    saved_s[task, idle.site] = queue.end_s(task, now_s) + queue.lost_s - here_s
    best = max(saved_s, key=saved_s.__getitem__, default=None)
    return best if best is not None and saved_s[best] > 0 else None
