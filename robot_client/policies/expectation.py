"""What a call should take on each site, for a program that asks before it calls.

It says the same as the outlooks of `forecast`, which policies decide from.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from offboard.common.errors import DeadlineMissed
from offboard.common.wording import duration, with_interval
from offboard.robot_client.policies.forecast import Forecast, Outlook


@dataclass(frozen=True, slots=True)
class Expectation:
    """What a call should take on one site; None: unknown.

    `seconds`: the expected time. `interval`: its 90 % interval, in seconds.
    `in_time`: the probability that a call that is sent there is answered within the deadline, if one was
    given. If the policy then also starts the task onboard in time, it is that of both sites together.
    `absent`: why the site cannot take the task now; None if it can.
    """

    seconds: float | None = None
    interval: tuple[float, float] | None = None
    in_time: float | None = None
    absent: str | None = None

    def __str__(self) -> str:
        if self.absent is not None:
            return self.absent
        if self.seconds is None:
            return "unknown"
        text = (
            duration(self.seconds) if self.interval is None else with_interval(self.seconds, *self.interval)
        )
        return text if self.in_time is None else f"{text}, in time with {self.in_time:.0%}"


def expectations(forecast: Forecast, absent: Mapping[str, str]) -> dict[str, Expectation]:
    """The expectation of each site; `absent` says why sites are not in the forecast."""
    found = {site: _expectation(one) for site, one in forecast.sites.items()}
    return found | {site: Expectation(absent=why) for site, why in absent.items()}


def missed(task: str, deadline_s: float, forecast: Forecast, absent: Mapping[str, str]) -> DeadlineMissed:
    """The error of a call without an answer in time, with what was expected when the call began."""
    expected = expectations(forecast, absent)
    shown = "; ".join(f"{site} {one}" for site, one in expected.items())
    return DeadlineMissed(f"task {task}: no answer within {deadline_s:g} s; expected: {shown}", expected)


def _expectation(outlook: Outlook) -> Expectation:
    seconds, low_s, high_s = outlook.predicted_s, outlook.low_s, outlook.high_s
    if seconds is None:
        return Expectation()
    return Expectation(
        seconds=seconds,
        interval=None if low_s is None or high_s is None else (low_s, high_s),
        in_time=outlook.in_time,
    )
