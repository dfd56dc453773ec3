"""When a stream asks for its next chunk, and whom. It has no clock: times come with each question.

What becomes of the answers is in `action_queue`; `action_stream` carries out what is decided here.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

from offboard.common.errors import ConfigError
from offboard.robot_client.sites.runner import ONBOARD
from offboard.robot_client.streams.arrival import Arrival

CALLS_PER_HORIZON = 4  # the usual limit: a new chunk for each quarter of one
BLEND = 2  # steps: seams become 0.4 times as large, P95 of the error 3 to 6 % larger (docs/streams.md)
MISS_RATE = 0.01  # one late chunk in a hundred
FAILED_S = 1.0  # pause of a site after a failed chunk
PROBE_S = 10.0  # between two questions to a server that is not used: it may be the better one now
HZ_MAX, HORIZON_MAX = 1000.0, 10_000  # beyond them a setting is a mistake


@dataclass(frozen=True, slots=True)
class Pace:
    """How fast actions are played and chunks are asked for.

    hz: steps per second. horizon: actions in a chunk. calls_per_s: the limit of questions to each site per
    second (None: CALLS_PER_HORIZON in a horizon). miss_rate: the share of chunks later than forecast.
    """

    hz: float
    horizon: int
    calls_per_s: float | None = None
    miss_rate: float = MISS_RATE

    def __post_init__(self) -> None:
        _check("hz", self.hz, 0 < self.hz <= HZ_MAX, f"above 0, at most {HZ_MAX:g}")
        whole = isinstance(self.horizon, int) and 1 <= self.horizon <= HORIZON_MAX
        _check("horizon", self.horizon, whole, f"a whole number from 1 to {HORIZON_MAX}")
        least = 1.0 / self.horizon_s
        if self.calls_per_s is not None:
            said = f"at least {least:.3g} (a chunk lasts {self.horizon_s:.3g} s)"
            _check("calls_per_s", self.calls_per_s, least <= self.calls_per_s < math.inf, said)
        _check("miss_rate", self.miss_rate, 0 < self.miss_rate < 0.5, "above 0, below 0.5")

    @property
    def step_s(self) -> float:
        return 1.0 / self.hz

    @property
    def horizon_s(self) -> float:
        return self.horizon / self.hz

    @property
    def every_s(self) -> float:
        """The least time between two questions to the same site."""
        return self.horizon_s / CALLS_PER_HORIZON if self.calls_per_s is None else 1.0 / self.calls_per_s


class Asking:
    """Decides for one stream. It has no lock: its driver holds one.

    A site is asked for one chunk at a time. `seen` numbers the observations: no site is asked about the same
    one twice. forecast: makes what forecasts the delays of one site, for a miss rate.
    """

    def __init__(self, pace: Pace, forecast: Callable[[float], Arrival] = Arrival) -> None:
        self._pace, self._forecast = pace, forecast
        self._arrivals: dict[str, Arrival] = {}
        self._under_way: dict[str, float] = {}  # when each was asked
        self._asked: dict[str, tuple[float, int]] = {}  # the last question: when, and about what
        self._failed: dict[str, float] = {}
        self.site: str | None = None  # where the stream is at home
        self._server: str | None = None  # the last server that was

    @property
    def patience_s(self) -> float:
        """How long a chunk is waited for: until all of its steps have passed."""
        return self._pace.horizon_s

    def late_s(self, site: str) -> float | None:
        """The forecast: the delay that the next chunk of this site should stay below."""
        arrival = self._arrivals.get(site)
        return None if arrival is None else arrival.late_s

    def useful_s(self, site: str, left_s: float, able: Iterable[str]) -> float:
        """How long an answer of this site that is asked for now is of use, if the queue lasts for `left_s`.

        That is until the queue ends, if another site could be asked now and take over in time. Otherwise a
        late answer is better than none, until its own last action is over.
        """
        others = [self.late_s(one) for one in able if one != site]
        in_time = any(late_s is not None and late_s <= left_s for late_s in others)
        return left_s if in_time else self._pace.horizon_s

    def due(self, now_s: float, left_s: float, lost_s: Mapping[str, float], *, seen: int) -> list[str]:
        """The sites to ask now. The caller asks them, and says so by `asked`.

        left_s: for how long the queue lasts. lost_s: the sites that can be asked, and what the quality that
        each one loses is worth in seconds.
        """
        able = {
            site: lost
            for site, lost in lost_s.items()
            if now_s - self._failed.get(site, -math.inf) >= FAILED_S
        }
        free = [
            site
            for site in able
            if site not in self._under_way and self._asked.get(site, (0.0, -1))[1] != seen
        ]
        sites = [site for site in free if site not in self._asked]  # every site is tried once
        costs = self._costs(able)
        self.site = self._home(costs)
        if self.site is not None and self.site != ONBOARD:
            self._server = self.site
        steady = self.site
        if steady is not None and self._overdue(steady, now_s):  # onboard is only asked when the queue ends
            servers = {site: cost for site, cost in costs.items() if site != ONBOARD}
            steady = _best({site: cost for site, cost in servers.items() if not self._overdue(site, now_s)})
        for site in free:
            if site == steady or site != ONBOARD or ONBOARD not in self._arrivals:
                unused = site not in (steady, self._server) and site in self._arrivals
                pause_s = PROBE_S if unused else self._pace.every_s
                if site not in sites and self._since(site, now_s) >= pause_s:
                    sites.append(site)
        if ONBOARD in free and ONBOARD not in sites:
            comes_s = [self.late_s(site) for site in sites]
            if steady in free and steady not in sites:  # it is asked when its pause is over
                pause_s = max(0.0, self._pace.every_s - self._since(steady, now_s))
                comes_s.append(pause_s + (self.late_s(steady) or 0.0))
            if self._runs_empty(now_s, left_s, comes_s):
                sites.append(ONBOARD)
        return sites

    def asked(self, site: str, now_s: float, *, seen: int) -> None:
        self._under_way[site] = now_s
        self._asked[site] = now_s, seen

    def arrived(self, site: str, now_s: float) -> None:
        """A chunk has come."""
        seconds = now_s - self._under_way.pop(site)
        self._arrivals.setdefault(site, self._forecast(self._pace.miss_rate)).learn(seconds)

    def lost(self, site: str) -> None:
        """A chunk was given up, as all of its steps have passed. It says nothing about when others come."""
        del self._under_way[site]
        if site in self._arrivals:
            self._arrivals[site].miss()

    def failed(self, site: str, now_s: float) -> None:
        """The site has failed, or its chunk was refused."""
        self._under_way.pop(site, None)
        self._failed[site] = now_s

    def begin(self) -> None:
        """A new episode: nothing that was asked counts any more."""
        self._under_way.clear()
        self._asked = dict.fromkeys(self._asked, (-math.inf, -1))

    def waits_for_server(self) -> bool:
        return any(site != ONBOARD for site in self._under_way)

    def mean_s(self, site: str) -> float | None:
        """The usual delay of this site."""
        return self._arrivals[site].mean_s if site in self._arrivals else None

    def forecasts(self) -> dict[str, float]:
        """The delay of each known site that its next chunk should stay below, in seconds."""
        return {site: one.late_s for site, one in self._arrivals.items() if one.late_s is not None}

    def _costs(self, able: Mapping[str, float]) -> dict[str, tuple[float, float]]:
        """Of each site that is known: the mean delay and the usual longest one, with its lost quality."""
        return {
            site: (arrival.mean_s + able[site], arrival.usual_s + able[site])
            for site, arrival in self._arrivals.items()
            if site in able and arrival.mean_s is not None and arrival.usual_s is not None
        }

    def _home(self, costs: Mapping[str, tuple[float, float]]) -> str | None:
        """The site where the stream is, unless another one is better even if its chunk comes late."""
        best, here = _best(costs), self.site
        if best is None or here is None or here not in costs:
            return best
        return best if costs[best][1] < costs[here][0] else here

    def _runs_empty(self, now_s: float, left_s: float, comes_s: list[float | None]) -> bool:
        """Whether onboard must start now, as no chunk should come before the queue ends.

        `comes_s`: when chunks of questions of this moment, or of the next pause, should be here.
        """
        late_s = self.late_s(ONBOARD)
        if late_s is None or left_s > late_s + self._pace.step_s:
            return False
        comes_s += [
            (late_s or 0.0) - (now_s - began_s)
            for site, began_s in self._under_way.items()
            if (late_s := self.late_s(site)) is not None and not self._overdue(site, now_s)
        ]
        return all(one is None or one > left_s for one in comes_s)

    def _overdue(self, site: str, now_s: float) -> bool:
        """An overdue chunk says nothing about when it will come."""
        began_s, late_s = self._under_way.get(site), self.late_s(site)
        return began_s is not None and late_s is not None and now_s - began_s > late_s

    def _since(self, site: str, now_s: float) -> float:
        """Since the last question, half a step more: a driver that is a little early need not wait on."""
        return now_s - self._asked[site][0] + 0.5 * self._pace.step_s if site in self._asked else -math.inf


def _best(costs: Mapping[str, tuple[float, float]]) -> str | None:
    return min(costs, key=lambda site: costs[site][0], default=None)


def _check(name: str, value: object, allowed: bool, said: str) -> None:
    if isinstance(value, bool) or not allowed:
        raise ConfigError(f"{name} {value!r}: must be {said}")
