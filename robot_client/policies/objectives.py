"""What a policy is to make small: from an outlook of a site to one number, less is better."""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

from offboard.common.errors import ConfigError
from offboard.robot_client.learning.intervals import NORMAL_90, Conformal


class Expected(NamedTuple):
    """What is expected of a task on one site."""

    seconds: float
    spread_s: float | None
    joules: float


class Objective(Protocol):
    def cost(self, expected: Expected, errors: Conformal) -> float:
        """`errors`: those of the site's predictions so far."""


class Mean:
    """Expected seconds."""

    def cost(self, expected: Expected, errors: Conformal) -> float:  # noqa: ARG002
        return expected.seconds


class Tail:
    """The time that 95 % of such tasks stay below."""

    SHARE = 0.95

    def cost(self, expected: Expected, errors: Conformal) -> float:
        below_s = errors.below(expected.seconds, self.SHARE)
        return expected.seconds + NORMAL_90 * (expected.spread_s or 0.0) if below_s is None else below_s


@dataclass(frozen=True)
class Deadline:
    """The probability to miss the deadline; between equals the faster one."""

    deadline_s: float

    def cost(self, expected: Expected, errors: Conformal) -> float:
        expected_s = max(0.0, expected.seconds)
        missed = errors.share_above(expected_s, self.deadline_s)
        if missed is None:
            missed = float(expected_s > self.deadline_s)
        return missed + 1e-3 * expected_s / (expected_s + self.deadline_s)


@dataclass(frozen=True)
class TimeAndEnergy:
    """Expected seconds plus `s_a_joule` for every joule."""

    s_a_joule: float

    def cost(self, expected: Expected, errors: Conformal) -> float:  # noqa: ARG002
        return expected.seconds + self.s_a_joule * expected.joules


OBJECTIVES = ("mean", "p95", "deadline", "energy")


def make(name: str, *, deadline_s: float | None = None, s_a_joule: float | None = None) -> Objective:
    """By name; ConfigError where what it needs is not given."""
    if name == "deadline":
        if deadline_s is None or not deadline_s > 0:
            raise ConfigError(f"objective 'deadline' needs a deadline above 0 s, not {deadline_s}")
        return Deadline(deadline_s)
    if name == "energy":
        if s_a_joule is None or not s_a_joule >= 0:
            raise ConfigError(f"objective 'energy' needs the seconds that a joule is worth, not {s_a_joule}")
        return TimeAndEnergy(s_a_joule)
    if name not in OBJECTIVES:
        raise ConfigError(f"objective {name!r} is not one of {', '.join(OBJECTIVES)}")
    return Tail() if name == "p95" else Mean()
