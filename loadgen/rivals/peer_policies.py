"""The rules by which peers use several servers, as rivals of the default. None of them computes onboard.

- `Replicate`: FogROS2-FT sends every request to all servers, and FogROS2-PLR over several links.
- `TwoServers`: a fixed redundancy of two, with which SafeTail compares its own choice.
- `HedgeAtP90`: what the PyPI package `hedge-python` does, made again for our sites: the first server, and a
  second one once the first has taken longer than 90 % of its latest times. Our allowance is its bucket.

A robot knows them by the paths of these classes, as it knows the classes of a user.
"""

from collections import Counter
from math import ceil, exp, log

from offboard.robot_client.policies import Decision, Forecast, Hedge
from offboard.robot_client.policies.forecast import costs_of
from offboard.robot_client.predictors import Prediction
from offboard.robot_client.sites.runner import ONBOARD

QUANTILE = 0.9
ACCURACY = 0.01  # of the sketch, relative (Masson et al., DDSketch, VLDB 2019)
SMALLEST_S = 1e-6


class _AmongServers:
    """Asks `choose` where a task runs, or runs it onboard while no server is there."""

    name: str

    def __init__(self, seed: int = 0) -> None:
        pass

    def decide(self, forecast: Forecast) -> Decision:
        servers = [site for site in forecast.sites if site != ONBOARD]
        if not servers:
            return Decision(ONBOARD, "no server is there", self.name)
        return self.choose(servers, forecast)

    def choose(self, servers: list[str], forecast: Forecast) -> Decision:
        raise NotImplementedError

    def _all_of(self, chosen: list[str], forecast: Forecast, why: str) -> Decision:
        spared = tuple(site for site in forecast.sites if site not in chosen)
        return Decision(chosen[0], why, self.name, both=True, spared=spared)


class Replicate(_AmongServers):
    """Every task runs on all servers at once, and the first answer is used."""

    name = "replicate"

    def choose(self, servers: list[str], forecast: Forecast) -> Decision:
        return self._all_of(servers, forecast, "all servers at once")


class TwoServers(_AmongServers):
    """Every task runs at once on the two servers that should be fastest."""

    name = "two-servers"

    def choose(self, servers: list[str], forecast: Forecast) -> Decision:
        unknown = [site for site in servers if forecast.sites[site].predicted_s is None]
        costs = costs_of(forecast.only([site for site in servers if site not in unknown]))
        by_cost = [*unknown, *sorted(costs, key=costs.__getitem__)]
        return self._all_of(by_cost[:2], forecast, "the two fastest servers")


class HedgeAtP90(_AmongServers):
    """The first server, and the next one after the 90th percentile of the first one's times."""

    name = "hedge-at-p90"
    predictor = "offboard.loadgen.rivals.peer_policies.QuantileSketch"

    def choose(self, servers: list[str], forecast: Forecast) -> Decision:
        first, p90_s = servers[0], forecast.sites[servers[0]].predicted_s
        second = None
        if len(servers) > 1 and p90_s is not None and forecast.duplicates >= 1:
            second = Hedge(servers[1], p90_s)
        return Decision(first, "the first server", self.name, second=second)


class QuantileSketch:
    """Predicts the 90th percentile of the last times, from counts in buckets of equal relative width.

    Two sketches take turns, each of `window` times: the older one is dropped when the newer one is full.
    """

    def __init__(self, window: int, seed: int = 0) -> None:  # noqa: ARG002 - nothing is random
        self._window = window
        self._log_gamma = log((1 + ACCURACY) / (1 - ACCURACY))
        self._older: Counter[int] = Counter()
        self._newer: Counter[int] = Counter()

    @property
    def full(self) -> bool:
        return len(self) >= self._window

    def __len__(self) -> int:
        return min(self._window, self._older.total() + self._newer.total())

    def learn(self, size: float, seconds: float) -> None:  # noqa: ARG002 - sizes are not looked at
        if self._newer.total() >= self._window:
            self._older, self._newer = self._newer, Counter()
        self._newer[ceil(log(max(seconds, SMALLEST_S)) / self._log_gamma)] += 1

    def predict(self, size: float, ahead: int = 1) -> Prediction | None:  # noqa: ARG002
        both = self._older + self._newer
        left = QUANTILE * both.total()
        for bucket in sorted(both):
            left -= both[bucket]
            if left <= 0:
                return Prediction(exp((bucket - 0.5) * self._log_gamma), None)
        return None
