"""A call with a deadline: how likely each site answers in time, alone or with onboard as its second.

`hedge` plans the second run, and `execution/race.py` starts it. The cost is that of the objective `deadline`.
"""

import math

from offboard.robot_client.policies.forecast import WHOLE, Forecast, Outlook, Quality
from offboard.robot_client.policies.objectives import Deadline, Expected
from offboard.robot_client.sites.runner import ONBOARD

UNLIKELY = 0.5  # probability to miss the deadline from which a second run onboard is not worth it
FEW_TIMES = 3.0  # predicted times that a task may take, by few runs
LONGEST = 1.1  # of the slowest run


def by_deadline(forecast: Forecast, deadline_s: float, *, slowest_s: float | None) -> Forecast:
    """The same forecast, in which the costs are those of a call with a deadline.

    Quality is weighed against the probability of an answer in time, not against seconds.
    A task that was sent to another site also starts onboard, at the latest when onboard should still make it.
    `slowest_s`: the longest of the last times onboard; None: the task runs on one site only.
    """
    alone, latest_s, rescue = Deadline(deadline_s), None, 0.0
    onboard = forecast.sites.get(ONBOARD)
    if slowest_s is not None and onboard is not None:
        start_s = max(0.0, deadline_s - _longest_s(onboard, slowest_s))
        missed = _missed(onboard, deadline_s - start_s)
        if missed is None:  # nothing is known of onboard, so it starts at once
            latest_s = start_s
        elif missed <= UNLIKELY:
            latest_s, rescue = start_s, 1.0 - missed
    sites = {}
    for site, one in forecast.sites.items():
        quality = one.quality if one.quality is WHOLE else Quality(one.quality.value)
        cost, in_time, missed = None, None, _missed(one, deadline_s)
        if missed is not None:
            in_time, worth = 1.0 - missed, quality.value * (1.0 - missed)
            if site != ONBOARD and onboard is not None:
                in_time += missed * rescue
                worth += missed * rescue * onboard.quality.value
            cost = 1.0 - worth + alone.slowness(_expected(one))
        sites[site] = one._replace(cost=cost, quality=quality, in_time=in_time)
    return forecast._replace(sites=sites, deadline_s=deadline_s, latest_s=latest_s)


def _longest_s(onboard: Outlook, slowest_s: float) -> float:
    """How long onboard may take: as long as its slowest run, and a tenth more; infinite if it is unknown."""
    if onboard.predicted_s is None:
        return math.inf
    predicted_s = max(0.0, onboard.predicted_s)
    if onboard.errors.few:
        return FEW_TIMES * predicted_s
    return LONGEST * max(slowest_s, onboard.errors.worst_s(predicted_s, onboard.error_s or 0.0))


def _missed(one: Outlook, within_s: float) -> float | None:
    """The probability that a site takes longer than this; None while nothing is known of it."""
    return None if one.predicted_s is None else Deadline(within_s).missed(_expected(one), one.errors)


def _expected(one: Outlook) -> Expected:
    assert one.predicted_s is not None
    return Expected(one.predicted_s, one.spread_s, one.joules, one.quality, error_s=one.error_s or 0.0)
