"""Which requests run together, and how long the server waits for more of them. Pure: times come in.

A *group* is what may run together: the kind of the requests, and the text of their key.
"""

import math
from dataclasses import dataclass, field

from offboard.common import tasks
from offboard.common.together import AT_MOST_MAX, Together

GROUPS_MAX = 256  # keys are told by robots
GAP_RATE = 0.2  # share of each new gap in what is expected
PATIENCE = 3.0  # expected gaps without a request, after which none is waited for
RISK = 0.25  # of what the next request would gain, is risked even if it was expected earlier
LEAST_RATE = 0.01  # share of each longer run in the shortest one
KEPT = 0.98  # of the weight of earlier runs, when a run is learned
TYPICAL_RATE = 0.1  # share of each new run in what is typical

Group = tuple[str, str]


class RunTimes:
    """The time of a run as a function of how many requests it holds: a line, by weighted least squares."""

    def __init__(self) -> None:
        self.least_s = math.inf  # of one request; it rises slowly if all runs are longer
        self._weight = self._n = self._s = self._nn = self._ns = 0.0

    def learn(self, count: int, run_s: float) -> None:
        own_s = run_s / count
        if own_s < self.least_s:
            self.least_s = own_s
        else:
            self.least_s += LEAST_RATE * (own_s - self.least_s)
        self._weight = KEPT * self._weight + 1.0
        self._n = KEPT * self._n + count
        self._s = KEPT * self._s + run_s
        self._nn = KEPT * self._nn + count * count
        self._ns = KEPT * self._ns + count * run_s

    def seconds(self, count: float) -> float | None:
        """The expected time of a run that holds `count` requests; None if nothing is known.

        It never falls with the number. As long as all runs were of one size, it does not depend on it.
        """
        if not self._weight:
            return None
        n, s = self._n / self._weight, self._s / self._weight
        varies = self._nn / self._weight - n * n
        each_s = max(0.0, (self._ns / self._weight - n * s) / varies) if varies > 1e-9 else 0.0
        return max(s - each_s * n + each_s * count, s / max(n, 1.0), 1e-9)


@dataclass(slots=True)
class _Arrivals:
    """The requests of a group since the last of its answers.

    gaps: by how many had come, the expected time until the next one.
    """

    gaps: dict[int, float] = field(default_factory=dict)
    come: int = 0
    last_s: float = -math.inf  # of the last request or answer
    held_since_s: float | None = None
    held_until_s: float = -math.inf

    def expected_s(self) -> float | None:
        """The gap until the next request, or that of the largest smaller number; None: not known."""
        known = (self.gaps.get(come) for come in range(min(self.come, AT_MOST_MAX), 0, -1))
        return next((gap_s for gap_s in known if gap_s is not None), None)

    def note(self, gap_s: float) -> None:
        before_s = self.gaps.get(self.come, gap_s)
        self.gaps[self.come] = before_s + GAP_RATE * (gap_s - before_s)


class Gathering:
    """What is learned of the kinds with `together`. `used`: whether any run had one.

    A request is held if the next one should come soon: all that wait then lose less than the next one gains,
    which is a whole run (count x gap < time of a run). After PATIENCE gaps, and once the wait has cost RISK
    of that, no more is expected. The gap is learned by the number of requests since the last answer, because
    robots that wait for answers ask again right after them.
    """

    def __init__(self) -> None:
        self.used = False
        self._arrivals: dict[Group, _Arrivals] = {}
        self._times: dict[str, RunTimes] = {}
        self._typical: dict[str, float] = {}  # requests of a run, by kind
        self._held_s = 0.0  # a typical wait for more requests
        self._ends_s: dict[int, float] = {}  # when each run should end, by its number
        self._runs = 0
        self._last = ""  # the kind that ran last

    def arrived(self, group: Group, waiting: int, now_s: float) -> None:
        """A request of this group has come. `waiting`: those of the group that were there before it."""
        arrivals = self._arrivals.pop(group, None) or _Arrivals()
        self._arrivals[group] = arrivals  # the last one to be forgotten
        if len(self._arrivals) > GROUPS_MAX:
            del self._arrivals[next(iter(self._arrivals))]
        if not waiting:  # what was held has been cancelled, or has started
            arrivals.held_since_s = None
        if 0 < arrivals.come < AT_MOST_MAX:
            arrivals.note(now_s - arrivals.last_s)
        arrivals.come += 1
        arrivals.last_s = now_s

    def answered(self, group: Group, waiting: int, now_s: float) -> None:
        """A run of this group has ended. `waiting`: the requests of the group that wait now."""
        arrivals = self._arrivals.get(group)
        if arrivals is None:
            return
        if 0 < arrivals.come < AT_MOST_MAX and now_s > arrivals.last_s:  # nothing came for so long
            arrivals.note(max(now_s - arrivals.last_s, arrivals.gaps.get(arrivals.come, 0.0)))
        arrivals.come, arrivals.last_s = waiting, now_s

    def until_s(self, group: Group, together: Together, count: int, now_s: float) -> float:
        """Until when `count` waiting requests of this group are held; not after `now_s`: they start now."""
        arrivals = self._arrivals.get(group)
        if arrivals is None or count >= together.at_most or not together.wait_s:
            return -math.inf
        since_s = now_s if arrivals.held_since_s is None else arrivals.held_since_s
        until_s = since_s + together.wait_s
        gap_s, run_s = arrivals.expected_s(), self.run_s(group[0], count)
        if gap_s is not None and run_s is not None:
            if count * gap_s >= run_s:
                return -math.inf
            patient_s = max(PATIENCE * gap_s, RISK * run_s / count)
            until_s = min(until_s, arrivals.last_s + patient_s)
        if until_s > now_s:
            arrivals.held_since_s, arrivals.held_until_s = since_s, until_s
        return until_s

    def began(self, group: Group, count: int, now_s: float) -> tuple[int, float]:
        """A run of `count` requests begins; returns its number, for `ended`, and how long it was held."""
        arrivals = self._arrivals.get(group)
        held_s = 0.0
        if arrivals is not None and arrivals.held_since_s is not None:
            # Afterwards it waited for a worker.
            held_s = min(now_s, arrivals.held_until_s) - arrivals.held_since_s
            arrivals.held_since_s = None
        self._held_s += TYPICAL_RATE * (held_s - self._held_s)
        before = self._typical.get(group[0], float(count))
        self._typical[group[0]] = before + TYPICAL_RATE * (count - before)
        self.used, self._last = True, group[0]
        self._runs += 1
        self._ends_s[self._runs] = now_s + (self.run_s(group[0], count) or 0.0)
        return self._runs, held_s

    def ended(self, number: int) -> None:
        self._ends_s.pop(number, None)

    def left_s(self, now_s: float) -> float:
        """Until the first of the runs that are known here should end."""
        return max(0.0, min(self._ends_s.values(), default=now_s) - now_s)

    def learn(self, kind: str, count: int, run_s: float) -> None:
        """A run of this kind with `count` requests took `run_s` seconds."""
        self._times.setdefault(kind, RunTimes()).learn(count, run_s)

    def run_s(self, kind: str, count: float) -> float | None:
        times = self._times.get(kind)
        return None if times is None else times.seconds(count)

    def least_s(self, kind: str) -> float | None:
        """About the shortest run of this kind, for each request; None if nothing is known."""
        times = self._times.get(kind)
        return None if times is None else times.least_s

    def own_s(self, kind: str, count: int, run_s: float) -> float:
        """The part of a run of `count` requests that one of them would have taken alone."""
        alone_s, usual_s = self.run_s(kind, 1), self.run_s(kind, count)
        return run_s * alone_s / usual_s if alone_s and usual_s else run_s

    def waits_s(self, waiting: int, free: int, now_s: float) -> float:
        """How long a request that came now would wait. `waiting`: requests, of any kind; `free`: workers.

        It waits until its run begins, and then for those that run with it. It counts as one of the kind that
        ran last.
        """
        kind = self._last
        together = tasks.kind_named(kind).together if kind else None
        typical, alone_s = self._typical.get(kind, 1.0), self.run_s(kind, 1)
        if together is None or alone_s is None:
            return 0.0
        others_s = (self.run_s(kind, typical) or alone_s) - alone_s
        if free > 0 and not waiting:
            return round(self._held_s + others_s, 6)
        first_s = self.left_s(now_s)
        if free > 0:
            first_s = self.run_s(kind, min(waiting, together.at_most)) or 0.0
            waiting -= together.at_most
        full_s = self.run_s(kind, together.at_most) or 0.0
        return round(first_s + max(0, waiting) // together.at_most * full_s + others_s, 6)
