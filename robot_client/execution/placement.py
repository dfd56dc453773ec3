"""Which task of a batch starts next, and where, so that the last one ends soonest. Pure: times are arguments.

List scheduling by earliest predicted finish, the longest task first (Graham 1969, Bounds on Multiprocessing
Timing Anomalies), begun anew whenever something has ended: only what can begin now is placed.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from offboard.robot_client.sites.runner import ONBOARD

SERVER_IN_FLIGHT = 2  # one runs while the next is on its way
SERVER_IN_FLIGHT_MAX = 8
ONBOARD_IN_FLIGHT = 1  # it runs one at a time, and nothing is on its way
QUEUED, UNQUEUED = 1.0, 0.1  # of the time that a task ran there, how long it had waited for a worker
BUDGET_SHARE = 0.5  # of the time after which a server's answer is given up: more is not put before a task
PACE_MIN = 0.1
OVERDUE = 0.1  # of its predicted time: what a task that should be done is taken to need still, at least


@dataclass(slots=True)
class Queue:
    """The tasks of a batch that one site has, first come, first served.

    `within_s`: a task that would take longer from now on is not added to others. `pace` is how many seconds
    of predicted time the site does in one: above 1 where it runs several at once, or hides the round trip.
    """

    site: str
    within_s: float
    limit: int = 0
    running: dict[int, float] = field(default_factory=dict)  # task to predicted seconds, in order of start
    _since_s: float = 0.0  # when the first of them got its turn
    _done_s: float = 0.0  # predicted seconds of those that ended
    _busy_s: float = 0.0

    def __post_init__(self) -> None:
        self.limit = ONBOARD_IN_FLIGHT if self.site == ONBOARD else SERVER_IN_FLIGHT

    def start(self, task: int, seconds: float, now_s: float) -> None:
        if not self.running:
            self._since_s = now_s
        self.running[task] = seconds

    def end(self, task: int, now_s: float) -> None:
        """It was answered, here or elsewhere."""
        self._done_s += self.running.pop(task)
        self._busy_s += now_s - self._since_s
        self._since_s = now_s

    def hear(self, queue_s: float | None, run_s: float | None) -> None:
        """How long an answered task waited for a worker of the server, and ran; None where it failed."""
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
        """In how many seconds one more task, predicted to take `seconds`, would be done.

        `behind_s`: predicted seconds of others that would come before it.
        """
        left_s = self._left_s(len(self.running), now_s)
        return max(seconds, (left_s + behind_s + seconds) / self._pace(seconds))

    def end_s(self, task: int, now_s: float) -> float:
        """In how many seconds a task that runs here should end."""
        place = list(self.running).index(task) + 1
        return self._left_s(place, now_s) / self._pace(self.running[task])

    def _left_s(self, count: int, now_s: float) -> float:
        """Predicted seconds that the first so many need still.

        A task that is overdue may need as long again as it is late: what ails it is not known.
        """
        if not self.running:
            return 0.0
        first, *others = list(self.running.values())[:count]
        done_s = (now_s - self._since_s) * self._pace(first)
        return max(first - done_s, done_s - first, OVERDUE * first) + sum(others)

    def _pace(self, seconds: float) -> float:
        """As if one more task, of so many seconds, had taken what was predicted."""
        if self._busy_s + seconds <= 0:
            return 1.0
        return max(PACE_MIN, (self._done_s + seconds) / (self._busy_s + seconds))


@dataclass(frozen=True, slots=True)
class Start:
    """What begins now: which waiting task, on which site, and in how many s each site would have it done."""

    place: int
    site: str
    finish_s: Mapping[str, float]


def next_start(
    predicted: Iterable[Mapping[str, float]], queues: Mapping[str, Queue], now_s: float
) -> Start | None:
    """The first task that should finish earliest where it can begin now.

    `predicted` gives the seconds of each waiting task by site, the longest task first; no more are asked for
    than are looked at. A task that is better off on a busy site waits for it, and those after it count it.
    """
    behind_s = dict.fromkeys(queues, 0.0)
    for place, seconds in enumerate(predicted):
        finish_s = {site: queues[site].finish_s(one, now_s, behind_s[site]) for site, one in seconds.items()}
        if not finish_s:
            continue
        best = min(finish_s, key=lambda site: (finish_s[site], site != ONBOARD))
        if queues[best].can_begin(seconds[best], now_s):
            return Start(place, best, finish_s)
        behind_s[best] += seconds[best]
    return None


def takeover(
    predicted: Mapping[int, Mapping[str, float]], queues: Mapping[str, Queue], now_s: float
) -> tuple[int, str] | None:
    """The running task that an idle site would save most time of, and that site; None where none does.

    `predicted` holds the seconds by site of the tasks that may run a second time.
    """
    saved_s: dict[tuple[int, str], float] = {}
    for idle in (queue for queue in queues.values() if not queue.running):
        for queue in queues.values():
            for task in queue.running.keys() & predicted.keys():
                if idle.site in predicted[task]:
                    saved_s[task, idle.site] = queue.end_s(task, now_s) - predicted[task][idle.site]
    best = max(saved_s, key=saved_s.__getitem__, default=None)
    return best if best is not None and saved_s[best] > 0 else None
