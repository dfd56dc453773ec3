"""Objectives: what a policy makes small, as a cost for each site. Less is better.

The joules that an objective weighs are estimated in `energy`.
"""

from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

from offboard.common.errors import ConfigError
from offboard.robot_client.policies.forecast import (
    SPREADS_90,
    WHOLE,
    PredictionErrors,
    Quality,
    widened_s,
)

S_PER_QUALITY = 1.0  # seconds that the whole quality is worth


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
