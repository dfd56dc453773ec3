"""Where a task should run: pure rules from a forecast to a decision, no clock, no socket, no chance.

What the decision leads to is in `offloader`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

from common.errors import ConfigError
from robot_client.runner import CLOUD, ONBOARD

PINNED = "pinned"  # what stands for a policy where the caller said where to run


@dataclass(frozen=True, slots=True)
class Outlook:
    """What is known of one site before a task.

    `predicted_s` and `spread_s` (None: nothing learnt); `full`: warm-up is over; `age`: tasks of this kind
    since the site last ran one; `failures`: in a row.
    """

    predicted_s: float | None
    spread_s: float | None
    full: bool
    age: int
    failures: int


@dataclass(frozen=True, slots=True)
class Forecast:
    """The size of a task and the outlook of every site that can take it now; onboard is always one."""

    size: float
    sites: Mapping[str, Outlook]


@dataclass(frozen=True, slots=True)
class Decision:
    """Run on `site`, or on all sites in parallel where `both`; the reason is for people."""

    site: str
    both: bool
    reason: str
    policy: str


class Policy(Protocol):
    """Called once a task, under the offloader's lock."""

    def decide(self, forecast: Forecast) -> Decision: ...


class Paper:
    """Algorithm 1 of Penmetcha, Kannan and Min, exactly."""

    def decide(self, forecast: Forecast) -> Decision:
        if not all(outlook.full for outlook in forecast.sites.values()):
            # Algorithm 1, warm-up branch: both sites, until both queues are full.
            return Decision(ONBOARD, len(forecast.sites) > 1, _warm_up_reason(forecast), "paper")
        predicted = {site: outlook.predicted_s or 0.0 for site, outlook in forecast.sites.items()}
        # Eq. 1: the cloud only where it is strictly faster; a tie stays onboard.
        site = min(predicted, key=lambda site: (predicted[site], site != ONBOARD))
        names = [site, *(name for name in predicted if name != site)]
        reason = " against ".join(f"{name} {predicted[name] * 1e3:.1f} ms" for name in names)
        return Decision(site, False, reason, "paper")


class Always:
    """One site for every task; onboard where that site cannot take it."""

    def __init__(self, site: str) -> None:
        self._site = site

    def decide(self, forecast: Forecast) -> Decision:
        if self._site in forecast.sites:
            return Decision(self._site, False, f"always {self._site}", self._site)
        return Decision(ONBOARD, False, f"{self._site} cannot take it", self._site)


_MAKERS: dict[str, Callable[[], Policy]] = {
    "paper": Paper,
    ONBOARD: lambda: Always(ONBOARD),
    CLOUD: lambda: Always(CLOUD),
}


def make(name: str) -> Policy:
    if name not in _MAKERS:
        raise ConfigError(f"policy {name!r} is not one of {', '.join(names())}")
    return _MAKERS[name]()


def names() -> tuple[str, ...]:
    return tuple(_MAKERS)


def _warm_up_reason(forecast: Forecast) -> str:
    cold = sorted(site for site, outlook in forecast.sites.items() if not outlook.full)
    return f"warm-up: the window of {' and '.join(cold)} is not full"
