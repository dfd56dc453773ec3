"""What each policy took over one recording, and how that compares with the better constant policy."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from offboard.common.errors import DataError
from offboard.loadgen.scenario.outcome import Outcome
from offboard.loadgen.table.table_two_figures import quantile
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

CONSTANTS = (ONBOARD, CLOUD)
USABLE = 2.0  # a link is usable if `cloud` takes at most this many times as long as `onboard`
MEAN_BEHIND, P99_BEHIND = 1.03, 1.10


@dataclass(frozen=True, slots=True)
class Taken:
    """The tasks of one policy over one recording, all seeds together."""

    mean_s: float
    p99_s: float
    over_oracle: float | None
    cloud_percent: float
    tasks: int
    lost: int


@dataclass(frozen=True, slots=True)
class Figures:
    """What each policy took over one recording."""

    family: str
    recording: str
    taken: Mapping[str, Taken]

    @property
    def better(self) -> str:
        """The constant policy with the smaller mean."""
        return min(CONSTANTS, key=lambda name: self.taken[name].mean_s)

    @property
    def usable(self) -> bool:
        return self.taken[CLOUD].mean_s <= USABLE * self.taken[ONBOARD].mean_s

    def mean_ratio(self, policy: str) -> float:
        return self.taken[policy].mean_s / self.taken[self.better].mean_s

    def p99_ratio(self, policy: str) -> float:
        """The P99 of a policy over that of the better constant, whose mean is smaller."""
        return self.taken[policy].p99_s / self.taken[self.better].p99_s

    def behind(self, policy: str) -> bool:
        return self.mean_ratio(policy) > MEAN_BEHIND or self.p99_ratio(policy) > P99_BEHIND


def figures_of(family: str, recording: str, runs: Mapping[str, Sequence[Outcome]]) -> Figures:
    """DataError if a policy answered no task, so that nothing can be compared."""
    for policy, outcomes in runs.items():
        if not any(run.answered for run in outcomes):
            raise DataError(f"{family}/{recording}: {policy} answered no task")
    return Figures(family, recording, {policy: _taken(outcomes) for policy, outcomes in runs.items()})


def _taken(runs: Sequence[Outcome]) -> Taken:
    answered = [one for run in runs for one in run.answered]
    seconds = np.array([one.response_s for one in answered])
    references = [one for run in runs for one in run.references]
    oracle_s = sum(one.oracle_s for one in references)
    return Taken(
        mean_s=float(seconds.mean()),
        p99_s=float(quantile(seconds[None], 99)[0]),
        over_oracle=sum(one.sent_s for one in references) / oracle_s if oracle_s else None,
        cloud_percent=100 * float(np.mean([CLOUD in one.sites for one in answered])),
        tasks=len(answered),
        lost=sum(sum(run.asked.values()) for run in runs) - len(answered),
    )
