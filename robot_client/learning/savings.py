"""What offloading would save: estimated while every task is answered onboard, from predictions and probes.

Which site a task would have been sent to is said by `policies/observe.py`.
"""

import math
from dataclasses import dataclass

from offboard.common.wording import duration, with_bounds
from offboard.robot_client.policies.prediction_errors import student_90
from offboard.robot_client.predictors.base import WARM_UP


@dataclass(frozen=True, slots=True)
class Savings:
    """The seconds that offloading would have saved per task: mean and 90 % interval; below 0: it costs time.

    `tasks`: all that were counted. `sent`: the share of them that the policy would have sent to another site.
    `probes`: how many of these really ran there too.
    `quality_s`: what the better answers of the other sites are worth, in seconds per task; it is not part of
    the mean. Below 0: they are worse. 0 for a task without variants.
    """

    mean_s: float
    low_s: float
    high_s: float
    tasks: int
    sent: float
    probes: int
    quality_s: float = 0.0

    def __str__(self) -> str:
        quality = ""
        if self.quality_s:
            better = "better" if self.quality_s > 0 else "worse"
            quality = (
                f"the answers would be {better}, which counts as {duration(abs(self.quality_s))} per task; "
            )
        return (
            f"{with_bounds(self.mean_s, self.low_s, self.high_s, 'per task')}; {quality}"
            f"{self.sent:.0%} of {self.tasks} tasks would be sent, {self.probes} were measured"
        )


class SavingsEstimate:
    """Estimates the savings for one kind of task.

    A task that stays onboard saves nothing. Of the others, each has a predicted saving. The mean error of
    these predictions is that of the probes, which are due after a number of tasks and so are a fair sample.
    This is the difference estimator of survey sampling (Särndal, Swensson and Wretman 1992, section 6.3).
    """

    def __init__(self) -> None:
        self._stayed = 0
        self._saved = _Moments()  # as predicted, in seconds
        self._errors = _Moments()
        self._quality_s = 0.0  # of all tasks

    def stay(self) -> None:
        """Take a task that the policy would have run onboard."""
        self._stayed += 1

    def move(self, saved_s: float, quality_s: float = 0.0) -> None:
        """Take a task that the policy would have sent away: its time onboard less the predicted time.

        `quality_s`: what the quality that the answer would have gained is worth.
        """
        self._saved.add(saved_s)
        self._quality_s += quality_s

    def probe(self, error_s: float) -> None:
        """Take a probe of the site that such a task would have used: predicted less measured time."""
        self._errors.add(error_s)

    def estimate(self) -> Savings | None:
        """The estimate; None before WARM_UP tasks, and before WARM_UP probes if any task would be sent."""
        saved, errors = self._saved, self._errors
        tasks = self._stayed + saved.count
        if tasks < WARM_UP or (saved.count and errors.count < WARM_UP):
            return None
        mean = half = 0.0
        if saved.count:
            mean = saved.mean + errors.mean
            half = student_90(errors.count - 1) * math.hypot(saved.error, errors.error)
        sent = saved.count / tasks
        return Savings(
            mean_s=sent * mean,
            low_s=sent * (mean - half),
            high_s=sent * (mean + half),
            tasks=tasks,
            sent=sent,
            probes=errors.count,
            quality_s=self._quality_s / tasks,
        )


class _Moments:
    """Mean and its standard error, by Welford's method."""

    def __init__(self) -> None:
        self.count = 0
        self.mean = 0.0
        self._squares = 0.0

    def add(self, one: float) -> None:
        self.count += 1
        before = one - self.mean
        self.mean += before / self.count
        self._squares += before * (one - self.mean)

    @property
    def error(self) -> float:
        """The standard error of the mean; 0 for one value."""
        return math.sqrt(self._squares / (self.count - 1) / self.count) if self.count > 1 else 0.0
