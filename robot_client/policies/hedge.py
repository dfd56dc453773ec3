"""The wrapper `hedge`: plans a second run for a task that is late, or whose deadline comes near.

When onboard must start for a deadline is in `objectives`. `execution/race.py` starts the second run.
"""

import math
from collections.abc import Mapping
from functools import partial

from offboard.common.wording import duration
from offboard.robot_client.policies.decision import Decision, Hedge, Policy
from offboard.robot_client.policies.forecast import Forecast, Outlook, cheapest
from offboard.robot_client.policies.prediction_errors import ERRORS_MIN, SPREADS_90, unit_s, widened_s
from offboard.robot_client.sites.runner import ONBOARD

NONE_LEFT = "no second run is left"  # a part of the reason
TAIL_SHARE = 0.2  # of the errors, the largest ones: they say how much longer a late task may take
BEYOND = 0.25  # of the distance from the median to the largest error: later than that, no task has ended


class WithHedges:
    """Adds a hedge: if the chosen site has not answered after some time, the task starts on a second one too.

    - Which site: of those that are known and not silent, the one that should take the least time. If there is
      none, onboard, of which nothing is known yet: a call must not wait for one known server alone.
    - When: `late_after_s` says it, from the past errors of the chosen site.
    - Whether: if a second run is left, and before the deadline, if there is one.

    With variants, the quality that the second site would lose counts as time that it needs. Until a deadline
    a better answer is waited for, so there no site with a worse one is a second site.

    After Dean and Barroso, The Tail at Scale (2013). They wait for a quantile of all times.

    A call with a deadline that was sent to another site starts onboard too, at the latest when onboard should
    still make it. That run is no matter of the allowance, just as a fallback.
    """

    pairs = True

    def __init__(self, inner: Policy) -> None:
        self._inner = inner

    def decide(self, forecast: Forecast) -> Decision:
        decision = self._inner.decide(forecast)
        if forecast.latest_s is not None and ONBOARD not in _first(decision, forecast.sites):
            decision = decision._replace(latest=Hedge(ONBOARD, forecast.latest_s))
        if decision.both or decision.second:  # it runs elsewhere anyway
            return decision
        hedge = _planned(decision.site, forecast)
        why = partial(_reason, decision, hedge)
        second = None if isinstance(hedge, str) else hedge
        return Decision(decision.site, why, decision.policy, second=second, latest=decision.latest)


def late_after_s(outlook: Outlook, worth_s: float, lost_s: float = 0.0) -> float | None:
    """After how many seconds a run on this site is late, if a second run is worth `worth_s`; None: unknown.

    It is the age from which on past tasks needed longest. An error is what a task took beyond its prediction,
    in units of half the prediction and half the usual time of the site; at most the last 100 count. Of the
    worst fifth of them, each but the largest is an age: the tasks with larger errors needed, in the mean, the
    mean of their errors minus this one longer. If the longest such rest is more than `worth_s`, that age is
    when waiting on costs more than the second run. Otherwise a run is late only if it takes longer than any
    before it: then it may never end. That is a quarter of the way from the median to the largest error beyond
    the largest one.

    For example, ten tasks were predicted to take 1 s, the usual time is 1 s, and the errors are 0 (eight
    times), 1 and 9. A task that was 1 s late needed 8 s more. So if a second run takes less than 8 s, a run
    is late after 1 + 1 = 2 s; if it takes longer, after 1 + 9 + 9 / 4 = 12.25 s.

    With fewer than ten errors, a run is late after 95 % of times that are normal around the prediction.

    `lost_s`: what the quality is worth that the second run would lose, a part of `worth_s`. If no past task
    was late by more than the second run is worth, that run starts this much later: the better answer should
    still come.
    """
    if outlook.predicted_s is None:
        return None
    scores, count = outlook.errors.scores, len(outlook.errors.scores)
    if count < ERRORS_MIN:
        if outlook.spread_s is None:
            return None
        return outlook.predicted_s + SPREADS_90 * outlook.spread_s + lost_s
    unit, largest = unit_s(outlook.predicted_s, outlook.errors.usual_s), scores[-1]
    tail = scores[count - round(TAIL_SHARE * count) :]
    late = largest + BEYOND * (largest - scores[count // 2])
    if unit * (largest - tail[0]) > worth_s:  # otherwise no rest in the tail was so long
        age, rest = _longest_rest(tail)
        if unit * rest > worth_s:
            late, lost_s = age, 0.0
    return max(0.0, outlook.predicted_s + widened_s(unit * late, outlook.error_s or 0.0)) + lost_s


def _longest_rest(tail: tuple[float, ...]) -> tuple[float, float]:
    """The error in the tail after which tasks took longest in the mean, and how much longer that was."""
    age = total = tail[-1]
    longest = float("-inf")
    for n, error in enumerate(reversed(tail[:-1]), 1):
        rest = total / n - error
        if rest >= longest:
            age, longest = error, rest
        total += error
    return age, longest


def _planned(first: str, forecast: Forecast) -> Hedge | str:
    """The hedge of a task that runs on this site, or why it has none."""
    if forecast.duplicates < 1:
        return NONE_LEFT
    chosen = forecast.sites[first]
    others = {
        site: one.predicted_s + one.quality.lost_s - chosen.quality.lost_s
        for site, one in forecast.sites.items()
        if site != first and one.predicted_s is not None and not one.condition.silent
    }
    onboard = forecast.sites.get(ONBOARD)
    if not others and first != ONBOARD and onboard is not None and onboard.predicted_s is None:
        others = {ONBOARD: math.inf}  # its first run may still be under way
    if forecast.deadline_s is not None:
        others = {site: s for site, s in others.items() if not _is_worse(forecast.sites[site], chosen)}
    if not others:
        if any(one.condition.silent for site, one in forecast.sites.items() if site != first):
            return "no second site answers"
        return "no second site is known" if forecast.deadline_s is None else "no second site is as good"
    second = cheapest(others)
    lost_s = forecast.sites[second].quality.lost_s - chosen.quality.lost_s
    after_s = late_after_s(chosen, others[second], max(0.0, lost_s))
    if after_s is None or after_s <= 0:  # a line below 0 does not say when a task is late
        return f"unknown when {first} is late"
    if forecast.deadline_s is not None and after_s >= forecast.deadline_s:
        return f"{first} is late only after the deadline"
    return Hedge(second, after_s)


def _reason(decision: Decision, hedge: Hedge | str) -> str:
    if isinstance(hedge, str):
        return f"{decision.reason}; no hedge: {hedge}"
    return f"{decision.reason}; {hedge.site} too after {duration(hedge.after_s)}"


def _first(decision: Decision, sites: Mapping[str, Outlook]) -> set[str]:
    """The sites that start at once."""
    return sites.keys() - decision.spared if decision.both else {decision.site}


def _is_worse(one: Outlook, than: Outlook) -> bool:
    return one.quality.value < than.quality.value
