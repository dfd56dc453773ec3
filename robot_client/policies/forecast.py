"""What a policy decides from: an outlook for each site, with the errors of its past predictions.

What it decides is in `decision`; `learning` makes the outlooks.
"""

import math
from bisect import bisect_left
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from offboard.common.tasks import Size
from offboard.robot_client.predictors.base import SIZE_MIN, WARM_UP
from offboard.robot_client.sites.runner import NOTHING, ONBOARD, UNMEASURED, Condition, Sending

ERRORS_MIN = 10  # with fewer errors, they are taken to be normal, and the spread counts as one of them
SPREADS_90 = 1.645  # standard deviations on each side that hold 90 % of the times, and above which 5 % are


@dataclass
class PredictionErrors:
    """How wrong the last predictions for one site were; a value that never changes.

    `scores`: the error of each prediction in units of `unit_s`, sorted. `usual_s`: the usual time of a task.
    `stopped`: the errors so far of late runs that were stopped, mostly because a hedge answered first.
    The methods return None while fewer than ERRORS_MIN errors are known, unless a spread helps.
    """

    scores: tuple[float, ...] = ()
    usual_s: float = 0.0
    stopped: tuple[float, ...] = ()

    def share_above(
        self, predicted_s: float, limit_s: float, spread_s: float | None = None, error_s: float = 0.0
    ) -> float | None:
        """The share of tasks with this prediction that should take longer than `limit_s`."""
        count = len(self.scores)
        if count < ERRORS_MIN:
            if not spread_s:
                return None
            scale_s = math.hypot(self._scale_s(predicted_s, spread_s), error_s)
            t = (limit_s - predicted_s) / scale_s
            return 0.5 * math.erfc(normal_of_student(t, count + 1) / math.sqrt(2.0))
        unit, margin_s = unit_s(predicted_s, self.usual_s), limit_s - predicted_s
        if error_s > 0.0:  # each past error may come with any error of this prediction
            of = error_s * math.sqrt(2.0)
            above = math.fsum([0.5 * math.erfc((margin_s - unit * score) / of) for score in self.scores])
        else:
            above = count - bisect_left(self.scores, margin_s / unit)
        # Never 0 or 1: a limit that no error has reached yet may still be missed.
        above += len(self.stopped)  # they might never have ended
        return (above + self._unseen(margin_s / unit)) / (count + len(self.stopped) + 1)

    @property
    def few(self) -> bool:
        return len(self.scores) < ERRORS_MIN

    def worst_s(self, predicted_s: float, error_s: float) -> float:
        """The time of a task with this prediction if it is as late as the latest one."""
        largest = max(0.0, self.scores[-1], *self.stopped[-1:])
        return predicted_s + widened_s(unit_s(predicted_s, self.usual_s) * largest, error_s)

    def _unseen(self, score: float) -> float:
        """How many further errors to expect above this score, if none was seen there.

        Half an error up to the size of the largest one, and beyond it less, with the square of the distance:
        so fast falls at least every tail that has a variance (Chebyshev's inequality).
        """
        largest = max(self.scores[-1], -self.scores[0])
        return 0.5 * (largest / score) ** 2 if score > largest else 0.5

    def half_90_s(self, predicted_s: float, spread_s: float, error_s: float = 0.0) -> float:
        """Half of the width of a 90 % interval while few errors are known."""
        scale_s = math.hypot(self._scale_s(predicted_s, spread_s), error_s)
        return student_90(len(self.scores) + 1) * scale_s

    def below(self, predicted_s: float, share: float, error_s: float = 0.0) -> float | None:
        """The time in seconds that this share of tasks with this prediction should stay below."""
        if len(self.scores) < ERRORS_MIN:
            return None
        scores = sorted(self.scores + self.stopped) if self.stopped else self.scores
        rank = min(len(scores), math.ceil(share * (len(scores) + 1))) - 1
        beyond_s = unit_s(predicted_s, self.usual_s) * scores[rank]
        return max(0.0, predicted_s + widened_s(beyond_s, error_s))

    def _scale_s(self, predicted_s: float, spread_s: float) -> float:
        """The root mean square of the errors and the spread."""
        unit = unit_s(predicted_s, self.usual_s)
        squares = math.fsum((unit * score) ** 2 for score in self.scores)
        return math.sqrt((squares + spread_s * spread_s) / (len(self.scores) + 1))


NO_ERRORS = PredictionErrors()


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


def student_90(freedom: int) -> float:
    """The 95 % quantile of Student's t, to 2 % from 2 degrees of freedom (Wallace 1959)."""
    z = SPREADS_90 * (8 * freedom + 3) / (8 * freedom + 1)
    return math.sqrt(freedom * math.expm1(z * z / freedom))


def normal_of_student(t: float, freedom: int) -> float:
    """The normal deviate that is as likely to be exceeded as this `t`, by the same approximation."""
    z = math.sqrt(freedom * math.log1p(t * t / freedom)) * (8 * freedom + 1) / (8 * freedom + 3)
    return math.copysign(z, t)


def unit_s(predicted_s: float, usual_s: float) -> float:
    """The unit of the errors: a part of the noise grows with the task, and a part does not."""
    unit = 0.5 * ((predicted_s if predicted_s > 0 else 0.0) + usual_s)
    return unit if unit > SIZE_MIN else 1.0  # errors in this unit must not leave the range of a float


def widened_s(beyond_s: float, error_s: float) -> float:
    """A distance from the prediction, moved up by what the prediction itself may be wrong by."""
    return beyond_s - abs(beyond_s) + math.hypot(beyond_s, SPREADS_90 * error_s)


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
