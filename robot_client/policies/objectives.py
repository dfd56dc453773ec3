"""Objectives: what a policy makes small, as a cost for each site; and what a task takes from the battery.

Less cost is better. What a deadline changes is here, too.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

from offboard.common.config import check, setting
from offboard.common.errors import ConfigError
from offboard.robot_client.policies.forecast import WHOLE, Forecast, Outlook, Quality
from offboard.robot_client.policies.prediction_errors import SPREADS_90, PredictionErrors, widened_s
from offboard.robot_client.sites.runner import ONBOARD, Execution

OBJECTIVE = "objective"  # the heading of its options in the help
S_PER_QUALITY = 1.0  # seconds that the whole quality is worth
FEW_TIMES = 3.0  # predicted times that a task onboard may take before a deadline, by few runs
LONGEST = 1.1  # of its slowest run, by enough runs
HANDOVER_S = 0.005  # for the start and the answer to pass through three threads of a busy robot


class Expected(NamedTuple):
    """What running a task on one site should take, and how good its answer is.

    `spread_s` is None while it is unknown. `bytes` are sent and received.
    `error_s`: the standard error of `seconds`, 0 if it is unknown.
    """

    seconds: float
    spread_s: float | None
    joules: float
    quality: Quality = WHOLE
    bytes: float = 0.0
    error_s: float = 0.0


@runtime_checkable
class Objective(Protocol):
    """Called once for each site that a task could run on."""

    def cost(self, expected: Expected, errors: PredictionErrors) -> float:
        """The cost of a site, in the objective's own unit; `errors` are those of its past predictions."""


class Mean:
    """The expected time and the worth of the lost quality, in seconds."""

    def cost(self, expected: Expected, errors: PredictionErrors) -> float:  # noqa: ARG002
        return expected.seconds + expected.quality.lost_s


class Tail:
    """The time that 95 % of such tasks stay below and the worth of the lost quality, in seconds."""

    SHARE = 0.95  # of the times; the others may take longer

    def cost(self, expected: Expected, errors: PredictionErrors) -> float:
        below_s = errors.below(expected.seconds, self.SHARE, expected.error_s)
        if below_s is None:
            below_s = expected.seconds + widened_s(SPREADS_90 * (expected.spread_s or 0.0), expected.error_s)
        return below_s + expected.quality.lost_s


@dataclass(frozen=True)
class Deadline:
    """The probability to miss a deadline; between equal probabilities, the faster site wins.

    With variants, it is the expected loss of quality: an answer after the deadline is worth nothing.
    """

    deadline_s: float

    def cost(self, expected: Expected, errors: PredictionErrors) -> float:
        worth = expected.quality.value * (1.0 - self.missed(expected, errors))
        return 1.0 - worth + self.slowness(expected)

    def missed(self, expected: Expected, errors: PredictionErrors) -> float:
        """The probability that a site alone misses the deadline."""
        expected_s = max(0.0, expected.seconds)
        missed = errors.share_above(expected_s, self.deadline_s, expected.spread_s, expected.error_s)
        return float(expected_s > self.deadline_s) if missed is None else missed

    def slowness(self, expected: Expected) -> float:
        """What makes the faster one of two sites with equal probabilities cheaper."""
        return 1e-3 * max(0.0, expected.seconds) / (max(0.0, expected.seconds) + self.deadline_s)


@dataclass(frozen=True)
class TimeAndSpending:
    """The expected time plus the worth of joules, megabytes (both ways) and lost quality, in seconds."""

    s_a_joule: float = 0.0
    s_a_megabyte: float = 0.0

    def cost(self, expected: Expected, errors: PredictionErrors) -> float:  # noqa: ARG002
        spent_s = self.s_a_joule * expected.joules + self.s_a_megabyte * 1e-6 * expected.bytes
        return expected.seconds + spent_s + expected.quality.lost_s


@dataclass(frozen=True)
class Energy:
    """The power and energy that a robot takes; measure your own robot for good values.

    The defaults: a Raspberry Pi 4 B draws 2.7 W idle and 6.4 W with all four cores busy (Geerling, Power
    Consumption Benchmarks, pidramble.com), so one core takes 0.9 W more; Wi-Fi takes 7 uJ per byte
    (Balasubramanian et al., Energy Consumption in Mobile Phones, IMC 2009, table 4).
    """

    compute_w: float = setting(
        0.9,
        "power that one busy core draws above idle, in watts",
        group=OBJECTIVE,
        rare=True,
        minimum=0.0,
        maximum=1e4,
    )
    idle_w: float = setting(
        0.0,
        "power drawn while waiting for an answer, in watts",
        group=OBJECTIVE,
        rare=True,
        minimum=0.0,
        maximum=1e4,
    )
    radio_j_byte: float = setting(
        7e-6,
        "energy to send or receive one byte, in joules",
        group=OBJECTIVE,
        rare=True,
        minimum=0.0,
        maximum=1.0,
    )

    def __post_init__(self) -> None:
        check(self, "")

    def onboard_j(self, cpu_s: float) -> float:
        """Joules of computing for `cpu_s` CPU seconds."""
        return self.compute_w * cpu_s

    def remote_j(self, seconds: float, bytes_moved: float) -> float:
        """Joules of waiting for `seconds`, and of sending and receiving the bytes."""
        return self.idle_w * seconds + self.radio_j_byte * bytes_moved


class Weighing:
    """What tasks take from the battery, and what the objective makes of a forecast."""

    def __init__(self, objective: Objective, energy: Energy) -> None:
        self._energy = energy
        self._objective = None if isinstance(objective, Mean) else objective  # every outlook has that cost

    def weighed(self, forecast: Forecast, *, capped: bool) -> Forecast:
        """The same forecast with the cost and the joules of each site, if an objective or a cap asks."""
        objective = self._objective
        if objective is None and not capped:
            return forecast
        sites = {}
        for site, one in forecast.sites.items():
            if one.predicted_s is None:
                sites[site] = one
                continue
            known = sites[site] = one._replace(joules=self._expected_j(site, one))
            if objective is not None:
                sites[site] = known._replace(cost=objective.cost(_expected(known), known.errors))
        return forecast._replace(sites=sites)

    def joules(self, execution: Execution) -> float:
        """What an execution took, in joules."""
        if execution.site == ONBOARD:
            return self._energy.onboard_j(execution.cpu_s or execution.run_s or execution.seconds)
        return self._energy.remote_j(execution.seconds, execution.bytes_out + execution.bytes_in)

    def _expected_j(self, site: str, one: Outlook) -> float:
        assert one.predicted_s is not None
        if site == ONBOARD:
            return self._energy.onboard_j((one.predicted_s - one.condition.wait_s) * one.cpu_share)
        return self._energy.remote_j(one.predicted_s, one.bytes)


def by_deadline(forecast: Forecast, deadline_s: float, *, slowest_s: float | None) -> Forecast:
    """The same forecast, in which the costs are those of a call with a deadline.

    Quality is weighed against the probability of an answer in time, not against seconds.
    A task that was sent to another site also starts onboard, at the latest when onboard should still make it.
    `slowest_s`: the longest of the last times onboard; None: the task runs on one site only.
    """
    alone, latest_s, rescue = Deadline(deadline_s), None, 0.0
    onboard = forecast.sites.get(ONBOARD)
    if slowest_s is not None and onboard is not None and (onboard.predicted_s or 0.0) < deadline_s:
        start_s = max(0.0, deadline_s - _longest_s(onboard, slowest_s) - HANDOVER_S)
        if start_s > 0.0 or forecast.duplicates >= 1:  # a second run from the start is no fallback
            latest_s, missed = start_s, _missed(onboard, deadline_s - start_s)
            rescue = 0.0 if missed is None else 1.0 - missed  # by an unknown onboard, nothing is promised
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
    return Expected(
        one.predicted_s,
        one.spread_s,
        one.joules,
        one.quality,
        bytes=one.bytes,
        error_s=one.error_s or 0.0,
    )


OBJECTIVES = (MEAN := "mean", "p95", "deadline", "energy", "metered")


def make(
    name: str,
    *,
    deadline_s: float | None = None,
    s_per_joule: float | None = None,
    s_per_megabyte: float | None = None,
) -> Objective:
    """The objective of this name; ConfigError if its setting is missing or wrong."""
    if name == "deadline":
        if deadline_s is None or not deadline_s > 0:
            raise ConfigError(f"objective 'deadline' needs a deadline above 0 s, not {deadline_s}")
        return Deadline(deadline_s)
    for of, what, worth_s in (("energy", "joule", s_per_joule), ("metered", "megabyte", s_per_megabyte)):
        if name == of if worth_s is None else not worth_s >= 0:
            raise ConfigError(f"objective {name!r} needs the seconds that a {what} is worth, not {worth_s}")
    if name in ("energy", "metered"):
        return TimeAndSpending(s_per_joule or 0.0, s_per_megabyte or 0.0)
    if name not in OBJECTIVES:
        raise ConfigError(f"objective {name!r} is not one of {', '.join(OBJECTIVES)}")
    return Tail() if name == "p95" else Mean()
