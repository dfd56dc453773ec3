"""What a policy decides from: an outlook for each site.

What it decides is in `decision`; `learning` makes the outlooks.
"""

import math
from collections.abc import Collection, Mapping
from typing import NamedTuple

from offboard.common.tasks import Size
from offboard.robot_client.policies.prediction_errors import NO_ERRORS, PredictionErrors
from offboard.robot_client.predictors.base import WARM_UP
from offboard.robot_client.sites.runner import NOTHING, ONBOARD, UNMEASURED, Condition, Sending


class Quality(NamedTuple):
    """How good the answers of a site are, and what its lost quality is worth in seconds."""

    value: float = 1.0
    lost_s: float = 0.0


WHOLE = Quality()  # of every site, for a task without variants


class Packing(NamedTuple):
    """What should be made smaller on the way to a site.

    `compress`: the numbers of the arguments to compress; empty if the kind packs all of them itself.
    `raw_bytes`, `bytes`: what a task would send without it, and what it should send.
    `seconds`: how long the robot should take for it.
    """

    compress: tuple[int, ...]
    raw_bytes: int
    bytes: float
    seconds: float


class Outlook(NamedTuple):
    """What is known of one site before a task runs. None means that nothing was learnt yet.

    `predicted_s` and `spread_s`: the prediction and its standard deviation.
    `error_s`: the standard error of the prediction itself. `low_s`, `high_s`: its 90 % interval.
    `full`: the warm-up of the predictor is over. `observations`: how many the prediction rests on.
    `age`: tasks of this kind since the site last ran one. `failures`: failed runs in a row.
    `in_flight`: tasks of any kind that run there now. `under_way`: one of this kind is among them.
    `bytes`: what running the task there should move. `cpu_share`: CPU seconds in each second of a run there.
    `condition`: what was measured of the site. `errors`: how wrong its past predictions were.
    `quality`: of the variant that the site runs; WHOLE for a task without variants.
    `sending`: what a run there would send, and `packing`: what of it should be made smaller; None: nothing.
    `in_time`: the probability that a call sent there is answered by its deadline; None: it has none.
    `joules`: what running the task there should take from the battery, if an objective or a cap asks for it.
    `cost`: what the objective makes of all this; less is better.

    Build it with keywords. It is a named tuple because every task needs one for each site, and a frozen
    dataclass takes twice as long to build.
    """

    predicted_s: float | None = None
    spread_s: float | None = None
    full: bool = False
    age: int = 0
    failures: int = 0
    observations: int = 0
    low_s: float | None = None
    high_s: float | None = None
    error_s: float | None = None
    in_flight: int = 0
    bytes: float = 0.0
    cpu_share: float = 1.0
    condition: Condition = UNMEASURED
    errors: PredictionErrors = NO_ERRORS
    quality: Quality = WHOLE
    packing: Packing | None = None
    sending: Sending = NOTHING
    under_way: bool = False
    in_time: float | None = None
    joules: float = 0.0
    cost: float | None = None

    @property
    def given_up(self) -> bool:
        """Whether all that is known of the site is that its runs fail, as many as a warm-up has."""
        return self.predicted_s is None and self.failures >= WARM_UP


class Forecast(NamedTuple):
    """The input size of a task, and the outlook of every site that can take it now.

    Onboard is always among `sites`, unless a wrapper leaves it out for the policy that it wraps.
    `last_site`: where the last task of this kind was sent. `duplicates`: second runs that may start now.
    `bytes_left`, `joules_left`: what the caps leave.
    `deadline_s`: of this call, or of the objective. `latest_s`: when onboard must start at the latest if a
    remote site has not answered, in seconds from the start; None: the task runs on one site only, or there is
    no deadline, or onboard would be too late anyway.

    Build it with keywords. It is a named tuple for the same reason as `Outlook`.
    """

    size: Size
    sites: Mapping[str, Outlook]
    last_site: str | None = None
    duplicates: float = math.inf
    bytes_left: float = math.inf
    joules_left: float = math.inf
    deadline_s: float | None = None
    latest_s: float | None = None

    def only(self, sites: Collection[str]) -> "Forecast":
        """The same forecast with these sites only."""
        return self._replace(sites={name: one for name, one in self.sites.items() if name in sites})


def cheapest(costs: Mapping[str, float]) -> str:
    """The site with the lowest cost; a tie stays onboard."""
    lowest = min(costs.values())
    if costs.get(ONBOARD) == lowest:
        return ONBOARD
    return next(site for site, cost in costs.items() if cost == lowest)


def costs_of(forecast: Forecast) -> dict[str, float]:
    """The cost of each site."""
    return {
        site: _cost_without_objective(one) if one.cost is None else one.cost
        for site, one in forecast.sites.items()
    }


def finishes_of(forecast: Forecast) -> dict[str, float]:
    """How long the task should take on each site that should answer, in seconds; 0 while it is unknown."""
    return {
        site: max(0.0, one.predicted_s or 0.0)
        for site, one in forecast.sites.items()
        if not (one.condition.silent or one.given_up)
    }


def home(forecast: Forecast) -> str:
    """Onboard, or the cheapest site where a wrapper has left onboard out."""
    return ONBOARD if ONBOARD in forecast.sites else cheapest(costs_of(forecast))


def _cost_without_objective(outlook: Outlook) -> float:
    """An unknown site costs nothing, so that it is tried, unless it is silent or was given up."""
    if outlook.predicted_s is None:
        return math.inf if outlook.condition.silent or outlook.given_up else 0.0
    return outlook.predicted_s
